"""The layout of a log that Rerun opens as it is.

Rerun reads MCAP itself: fixes and events show at once; a ``trainlog.*`` message arrives as one
structure with all its fields, which a plot takes apart only with a layout that names them.
`write_layout` writes that layout, one for all logs; `scalars` takes the fields out for further work
in Python. Values stay in SI units there, and there is no timeline over position: for that a
recording has to be made, see `trainlog.replay.write_replay`.
"""

from __future__ import annotations

from itertools import groupby
from pathlib import Path
from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping
from rerun.chunk import DeriveLens, McapReader

from trainlog.errors import InputError
from trainlog.formats.files import atomic_write
from trainlog.replay.layout import SharedAxis, plot
from trainlog.topics import EVENTS, GNSS_FIX, TOPICS, Field, Topic

SCALARS = "Scalars:scalars"
"""What a plot draws, by Rerun's name."""

DRAWN = tuple(topic for topic in TOPICS.values() if not topic.foxglove)
"""Topics whose fields are plotted; the others are points on the map and text."""


def write_layout(path: str | Path, application: str) -> None:
    """Write the layout with which Rerun shows a log's own messages, as an ``.rbl`` file.

    Parameters
    ----------
    path : path
        Ends in ``.rbl``; written whole or not at all.
    application : str
        Rerun's id of what it fits: for a log opened directly the file's name without ``.mcap``;
        for a log converted by ``rerun mcap convert`` what was given as ``--application-id``.

    Raises
    ------
    InputError
        If the path ends otherwise or cannot be written.

    Examples
    --------
    >>> import trainlog
    >>> trainlog.write_layout("nonstop.rbl", "nonstop")
    """
    if Path(path).suffix != ".rbl":
        raise InputError("is not the name of a Rerun layout", file=path, remedy="end it in .rbl")
    tabs = [_tab(topic) for topic in DRAWN]
    beside = rrb.Vertical(
        rrb.MapView(origin=GNSS_FIX.name, name="Satellite fix", zoom=12.0),
        rrb.TextLogView(origin=EVENTS.name, name="Events"),
    )
    layout = rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*tabs), beside, column_shares=[3.0, 1.0]), collapse_panels=True
    )
    layout.top_panel = SharedAxis()
    with atomic_write(path) as temporary:
        layout.save(application, temporary)


def scalars(log: str | Path, topic: str, field: str) -> Any:
    """One field of a log as a lazy stream of Rerun chunks with scalars, on the log's own clocks.

    Parameters
    ----------
    log : path
    topic : str
        A ``trainlog.*`` topic.
    field : str
        Field of it; one ``per_axle`` gives as many scalars a row.

    Returns
    -------
    rerun.chunk.LazyChunkStream
        Its entity is ``topic/field``.

    Raises
    ------
    InputError
        If there is no such topic or field.

    Examples
    --------
    >>> import trainlog
    >>> stream = trainlog.scalars("sample_logs/nonstop.mcap", "/train/state", "speed")
    >>> sum(chunk.num_rows for chunk in stream.to_chunks())
    11832
    """
    found = next((each for each in DRAWN if each.name == topic), None)
    if found is None or field not in {each.name for each in found.fields}:
        raise InputError(
            f"no field {field} of topic {topic} to plot",
            remedy=f"topics: {', '.join(each.name for each in DRAWN)}",
        )
    lens = DeriveLens(_message(found), output_entity=f"{topic}/{field}").to_component(
        rr.Scalars.descriptor_scalars(), _selector(found.field(field))
    )
    return McapReader(log, include_topic_regex=[f"^{topic}$"]).stream().lenses([lens])


def _tab(topic: Topic) -> Any:
    """The fields of a topic, one plot a unit."""
    fields = sorted(topic.fields, key=lambda field: field.unit)
    plots = [
        plot(
            [topic.name],
            f"{', '.join(field.name for field in group)} [{unit}]",
            overrides={topic.name: [_line(topic, field) for field in group]},
        )
        for unit, group in ((u, list(g)) for u, g in groupby(fields, key=lambda each: each.unit))
    ]
    return rrb.Vertical(*plots, name=topic.name[1:])


def _line(topic: Topic, field: Field) -> Any:
    """How a plot takes a field out of its message."""
    source = VisualizerComponentMapping(
        SCALARS,
        ComponentSourceKind.SourceComponent,
        source_component=_message(topic),
        selector=_selector(field),
    )
    return rr.SeriesLines(names=field.name).visualizer(mappings=[source])


def _message(topic: Topic) -> str:
    return f"{topic.message}:message"


def _selector(field: Field) -> str:
    """Rerun's path to a field; brackets take a list apart."""
    return f".{field.name}[]" if field.per_axle else f".{field.name}"
