-- The tables of version 1 in PostgreSQL, as trainlog made them then (commit e971095).
CREATE TABLE computations (
    id BIGSERIAL NOT NULL,
    analysis TEXT COLLATE "C" NOT NULL,
    code TEXT COLLATE "C" NOT NULL,
    parameters TEXT COLLATE "C" NOT NULL,
    content TEXT NOT NULL,
    last BIGINT NOT NULL,
    PRIMARY KEY (id),
    UNIQUE (analysis, code, parameters)
);
CREATE TABLE header (
    key TEXT NOT NULL,
    value TEXT NOT NULL,
    PRIMARY KEY (key)
);
CREATE TABLE trips (
    id BIGSERIAL NOT NULL,
    key TEXT COLLATE "C" NOT NULL,
    name TEXT COLLATE "C",
    train TEXT COLLATE "C",
    kind TEXT COLLATE "C",
    line TEXT COLLATE "C",
    direction TEXT COLLATE "C",
    start BIGINT,
    "end" BIGINT,
    duration DOUBLE PRECISION,
    distance DOUBLE PRECISION,
    km_from DOUBLE PRECISION,
    km_to DOUBLE PRECISION,
    weather TEXT COLLATE "C",
    load DOUBLE PRECISION,
    labels JSON,
    topics JSON,
    passport JSON,
    quality TEXT COLLATE "C",
    damage TEXT COLLATE "C",
    repairs BIGINT,
    samples BIGINT,
    messages BIGINT,
    software TEXT COLLATE "C",
    added BIGINT,
    sha256 TEXT COLLATE "C" NOT NULL,
    source TEXT NOT NULL,
    blocks BYTEA NOT NULL,
    standing TEXT NOT NULL,
    same_as BIGINT,
    share DOUBLE PRECISION,
    PRIMARY KEY (id)
);
CREATE UNIQUE INDEX trips_by_content ON trips (sha256);
CREATE INDEX trips_by_duration ON trips (duration);
CREATE INDEX trips_by_key ON trips (key);
CREATE INDEX trips_by_line ON trips (line, start);
CREATE INDEX trips_by_time ON trips (start, "end");
CREATE INDEX trips_by_train ON trips (train, start);
CREATE TABLE files (
    id BIGSERIAL NOT NULL,
    path TEXT COLLATE "C" NOT NULL,
    sha256 TEXT COLLATE "C" NOT NULL,
    size BIGINT,
    changed BIGINT,
    trip BIGINT,
    state TEXT NOT NULL,
    reason TEXT NOT NULL,
    PRIMARY KEY (id),
    UNIQUE (path, sha256),
    FOREIGN KEY(trip) REFERENCES trips (id)
);
CREATE INDEX files_by_content ON files (sha256);
CREATE INDEX files_by_state ON files (state);
CREATE INDEX files_by_trip ON files (trip, state, path);
CREATE TABLE result_files (
    id BIGSERIAL NOT NULL,
    computation BIGINT NOT NULL,
    name TEXT NOT NULL,
    rows BIGINT NOT NULL,
    PRIMARY KEY (id),
    UNIQUE (computation, name),
    FOREIGN KEY(computation) REFERENCES computations (id)
);
CREATE TABLE trip_edges (
    trip BIGINT NOT NULL,
    place INTEGER NOT NULL,
    edge TEXT COLLATE "C" NOT NULL,
    km_from DOUBLE PRECISION,
    km_to DOUBLE PRECISION,
    direction TEXT NOT NULL,
    PRIMARY KEY (trip, place),
    FOREIGN KEY(trip) REFERENCES trips (id)
);
CREATE INDEX trip_edges_by_edge ON trip_edges (edge, trip);
CREATE TABLE results (
    computation BIGINT NOT NULL,
    trip BIGINT NOT NULL,
    state TEXT NOT NULL,
    reason TEXT NOT NULL,
    file BIGINT,
    rows BIGINT NOT NULL,
    seconds DOUBLE PRECISION,
    PRIMARY KEY (computation, trip),
    FOREIGN KEY(computation) REFERENCES computations (id),
    FOREIGN KEY(trip) REFERENCES trips (id),
    FOREIGN KEY(file) REFERENCES result_files (id)
);
CREATE INDEX results_by_file ON results (file);
