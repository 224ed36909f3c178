"""Random lines, trains and results for the tests of the formats."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from hypothesis import strategies as st

from trainlog.railway import BrakingCurves, Configuration, CurvatureProfile, Geometry, ParameterSet
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence
from trainlog.railway.line import Line, LineReference, Station, StepProfile, Survey, Tunnel
from trainlog.railway.resistance import EffortCurve, RunningResistance
from trainlog.railway.train import Axles, Brake, Consist, ConsistBrake, Coupler, Train, Vehicle
from trainlog.railway.trajectory import Journey, TimingPoint, Trajectory

NAMES = st.text(min_size=1, max_size=12)
SHARES = st.floats(0.0, 1.0, allow_subnormal=False)


def sizes(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


def arrays(size: int, low: float, high: float) -> st.SearchStrategy[Any]:
    return st.lists(sizes(low, high), min_size=size, max_size=size).map(
        lambda values: np.array(values, dtype=np.float64)
    )


@st.composite
def positions(draw: Callable[..., Any], length: float) -> Any:
    """Rising positions that begin at 0."""
    marks = draw(st.lists(st.integers(1, 999), max_size=6, unique=True))
    return np.array([0.0, *(length * mark / 1000.0 for mark in sorted(marks))])


@st.composite
def lines(draw: Callable[..., Any]) -> Line:
    length = draw(sizes(10.0, 1e6))
    limits, gradients, bends = (draw(positions(length)) for _ in range(3))
    curvature = st.one_of(st.just(0.0), sizes(1e-9, 0.02), sizes(-0.02, -1e-9))
    bend = st.lists(curvature, min_size=bends.size, max_size=bends.size).map(np.array)
    points = draw(positions(length))
    geometry = None
    if points.size > 1:
        ends = draw(arrays(points.size, -90.0, 90.0)), draw(arrays(points.size, -180.0, 180.0))
        geometry = Geometry(points, *ends, draw(NAMES))
    stops = sorted(draw(st.lists(sizes(0.0, 1.0), max_size=4)))
    half = 0.5 * length
    tunnel = st.builds(Tunnel, sizes(0.0, half), sizes(1e-3 * half, half), sizes(1.0, 200.0))
    far, against = arrays(bends.size, -1e6, 1e6), arrays(gradients.size, 0.1, 99.0)
    return Line(
        name=draw(NAMES),
        length=length,
        stations=tuple(Station(draw(NAMES), stop * length) for stop in stops),
        speed_limits=StepProfile(limits, draw(arrays(limits.size, 0.1, 100.0))),
        speed_limits_reverse=draw(st.none() | st.builds(StepProfile, st.just(gradients), against)),
        gradients=StepProfile(gradients, draw(arrays(gradients.size, -0.2, 0.2))),
        curvatures=draw(st.none() | st.builds(CurvatureProfile, st.just(bends), bend, bend)),
        tunnels=tuple(draw(st.lists(tunnel, max_size=2))),
        altitude=draw(sizes(-100.0, 3000.0)),
        geometry=geometry,
        source=draw(st.text(max_size=20)),
        braking_parameters=draw(
            st.dictionaries(st.sampled_from(["M_NVAVADH", "Kt_int"]), sizes(0.0, 2.0))
        ),
        survey=draw(st.none() | st.builds(Survey, sizes(1e-6, 0.01), st.none() | sizes(1.0, 1e5))),
        reference=draw(st.none() | st.builds(LineReference, NAMES, st.just(bends), far, far)),
    )


RESISTANCES = st.builds(RunningResistance, sizes(0.0, 1e5), sizes(0.0, 1e4), sizes(0.0, 1e3))
CURVES = st.lists(st.tuples(sizes(0.0, 100.0), sizes(0.1, 2.0)), max_size=3).map(tuple)


@st.composite
def effort_curves(draw: Callable[..., Any], least: float = 0.0) -> EffortCurve:
    steps = draw(arrays(draw(st.integers(1, 6)), 0.01, 20.0))
    speeds = np.concatenate(([0.0], np.cumsum(steps)))
    return EffortCurve(speeds, draw(arrays(speeds.size, least, 1e6)))


BRAKING = st.dictionaries(st.sampled_from(["K_dry_rst", "T_be", "v_uncertainty"]), sizes(0.0, 9.0))
TRAINS = st.builds(
    Train,
    name=NAMES,
    mass=sizes(1.0, 1e7),
    rotating_mass_factor=SHARES,
    resistance=RESISTANCES,
    max_tractive_effort=sizes(1.0, 1e6),
    max_traction_power=sizes(1.0, 1e8),
    max_dynamic_braking_effort=sizes(0.0, 1e6),
    max_dynamic_braking_power=sizes(0.0, 1e8),
    max_pneumatic_braking_effort=sizes(0.0, 1e7),
    max_speed=sizes(1.0, 150.0),
    max_acceleration=sizes(0.01, 3.0),
    max_deceleration=sizes(0.01, 3.0),
    efficiency_traction=sizes(0.01, 1.0),
    efficiency_regeneration=SHARES,
    max_load=sizes(0.0, 1e6),
    length=sizes(0.0, 1e3),
    tunnel_resistance=CURVES,
    axles=st.builds(Axles, st.integers(1, 40), sizes(1.0, 1e6), sizes(0.1, 2.0), sizes(0.0, 1e4)),
    brake=st.builds(Brake, sizes(0.0, 5.0), sizes(0.0, 5.0)),
    braking_curves=st.none() | st.builds(BrakingCurves, CURVES, CURVES, BRAKING),
    seats=st.none() | st.integers(1, 2000),
    coaches=st.none() | st.integers(1, 50),
    source=st.text(max_size=20),
    assumed=st.lists(NAMES, max_size=3).map(tuple),
    traction_curve=st.none() | effort_curves(1.0),
    dynamic_braking_curve=st.none() | effort_curves(),
)

SINGLE = (st.none(), st.booleans(), st.integers(), sizes(-1e300, 1e300), st.text(max_size=8))
NESTED = st.recursive(
    st.one_of(SINGLE),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3),
    max_leaves=6,
)
DETAILS = st.dictionaries(NAMES, NESTED, max_size=3)
MASS, OTHER_MASS, POWER = sizes(1.0, 1e7), sizes(0.0, 1e6), sizes(1.0, 1e8)
CONFIGURATIONS = st.builds(Configuration, NAMES, MASS, OTHER_MASS, RESISTANCES, POWER)
PARAMETER_SETS = st.builds(
    ParameterSet,
    train=NAMES,
    configurations=st.lists(CONFIGURATIONS, max_size=3).map(tuple),
    common=st.none() | RESISTANCES,
    common_covariance=st.none() | arrays(9, -1e9, 1e9).map(lambda values: values.reshape(3, 3)),
    speed_range=st.tuples(sizes(0.0, 20.0), sizes(20.0, 90.0)),
    details=st.lists(DETAILS, max_size=2),
    provenance=DETAILS,
)


@st.composite
def trajectories(draw: Callable[..., Any]) -> Trajectory:
    nodes = draw(positions(draw(sizes(10.0, 1e5))).filter(lambda found: found.size > 1))
    n = nodes.size - 1
    configurations = tuple(draw(st.lists(CONFIGURATIONS, min_size=1, max_size=3)))
    q = len(configurations)
    return Trajectory(
        line=draw(NAMES),
        train=draw(NAMES),
        positions=nodes,
        configurations=configurations,
        speeds=draw(arrays(q * (n + 1), 0.0, 90.0)).reshape(q, n + 1),
        times=draw(arrays(q * (n + 1), 0.0, 1e4)).reshape(q, n + 1),
        tractive_effort=draw(arrays(n, 0.0, 1e6)),
        braking_effort=draw(arrays(q * n, 0.0, 1e6)).reshape(q, n),
        running_time=draw(sizes(1.0, 1e5)),
        direction=draw(st.sampled_from(["forward", "reverse"])),
        certificate=draw(DETAILS),
        provenance=draw(DETAILS),
    )


@st.composite
def maps(draw: Callable[..., Any]) -> TrackConditionMap:
    bins, levels = draw(st.integers(1, 6)), draw(st.integers(1, 4))
    numbers = arrays(bins, -10.0, 10.0)

    def layer() -> ConditionLayer:
        observed = np.array(draw(st.lists(st.booleans(), min_size=bins, max_size=bins)))
        mean = draw(numbers)
        mean[~observed] = draw(st.sampled_from([np.nan, -1.5]))
        return ConditionLayer(
            log_mean=mean,
            log_std=draw(arrays(bins, 0.0, 2.0)),
            observed=observed,
            evidence=DailyEvidence.of_bins(
                draw(st.integers(0, 30_000)),
                draw(arrays(bins, 0.0, 9.0)),
                np.round(draw(arrays(bins, 0.0, 1e6)) * 2**20) / 2**20,
                draw(numbers),
                draw(arrays(bins * levels, 0.0, 1e4)).reshape(bins, levels),
            ),
        )

    return TrackConditionMap(
        line=draw(NAMES),
        length=bins * 25.0 - draw(sizes(0.0, 20.0)),
        bin_length=25.0,
        levels=draw(arrays(levels, 0.0, 0.5)),
        layers={name: layer() for name in draw(st.lists(NAMES, max_size=2, unique=True))},
        trips=tuple(draw(st.lists(DETAILS, max_size=2))),
        settings=draw(st.dictionaries(NAMES, sizes(-1e9, 1e9), max_size=2)),
    )


@st.composite
def journeys(draw: Callable[..., Any]) -> Journey:
    def window(high: float) -> tuple[float | None, float | None]:
        lower, upper = sorted((draw(sizes(0.0, high)), draw(sizes(0.0, high))))
        return draw(st.sampled_from([(lower, upper), (lower, None), (None, upper), (None, None)]))

    stops = sorted(draw(st.lists(sizes(0.0, 1e5), min_size=2, max_size=5)))
    return Journey(
        name=draw(NAMES),
        line=draw(NAMES),
        points=tuple(TimingPoint(stop, *window(1e4), *window(90.0)) for stop in stops),
        source=draw(st.text(max_size=20)),
    )


def assert_same(found: Any, expected: Any, tolerance: float = 0.0) -> None:
    """Every field of two dataclasses agrees; numbers within a relative tolerance."""
    if is_dataclass(expected) and not isinstance(expected, type):
        assert type(found) is type(expected)
        for field in fields(expected):
            assert_same(getattr(found, field.name), getattr(expected, field.name), tolerance)
    elif isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            assert_same(found[key], value, tolerance)
    elif isinstance(expected, list | tuple):
        assert len(found) == len(expected)
        for left, right in zip(found, expected, strict=True):
            assert_same(left, right, tolerance)
    elif isinstance(expected, float | np.ndarray):
        np.testing.assert_allclose(found, expected, rtol=tolerance, atol=1e-290 * tolerance)
    else:
        assert found == expected


FEW = sizes(0.0, 1e6)
POSITIVE = sizes(1e-3, 1e8)
VEHICLES = st.builds(
    Vehicle,
    name=NAMES,
    mass=POSITIVE,
    length=POSITIVE,
    resistance=st.builds(RunningResistance, FEW, FEW, FEW),
    rotating_mass=FEW,
    max_tractive_effort=FEW,
    max_traction_power=st.one_of(st.just(np.inf), POSITIVE),
    max_braking_effort=FEW,
)
COUPLERS = st.builds(
    Coupler,
    stiffness=POSITIVE,
    nonlinearity=sizes(-500.0, 500.0),
    damping=FEW,
    slack=sizes(0.0, 0.1),
    buffing_stiffness=st.none() | POSITIVE,
    buffing_nonlinearity=st.none() | sizes(-500.0, 500.0),
)


@st.composite
def consists(draw: Callable[..., Any]) -> Consist:
    # Few kinds, so that equal neighbours occur.
    kinds = draw(st.lists(VEHICLES, min_size=1, max_size=2))
    vehicles = draw(st.lists(st.sampled_from(kinds), min_size=1, max_size=6))
    joints = draw(st.lists(COUPLERS, min_size=1, max_size=2))
    count = len(vehicles) - 1
    return Consist(
        draw(NAMES),
        tuple(vehicles),
        tuple(draw(st.lists(st.sampled_from(joints), min_size=count, max_size=count))),
        brake=ConsistBrake(draw(FEW), draw(FEW), draw(st.just(np.inf) | POSITIVE)),
        source=draw(st.text(max_size=8)),
        assumed=tuple(draw(st.lists(NAMES, max_size=2))),
    )


CONSISTS = consists()
