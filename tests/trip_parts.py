"""Parts of trips: as if some of it had not been recorded."""

from dataclasses import replace

from trainlog.trip import Trip


def without(trip: Trip, *topics: str) -> Trip:
    return replace(trip, topics={n: each for n, each in trip.topics.items() if n not in topics})
