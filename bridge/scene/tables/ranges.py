"""Ranges of scene numbers as types, for validation, messages and tools."""

from math import pi
from typing import Annotated, Any, Literal, TypeAlias

from msgspec import Meta

LARGEST = 1e9
"""Largest magnitude of any scene number: every range is closed, which excludes infinity."""
MAX_AXES = 7
MAX_TICKS = 20_000_000
"""Largest number of ticks of a run."""

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Meta(gt=0.0, le=LARGEST)]
NonNegative = Annotated[float, Meta(ge=0.0, le=LARGEST)]
Ratio = Annotated[float, Meta(gt=0.0, le=1.0)]
Seconds = Annotated[float, Meta(ge=0.0, le=1e6)]
MIN_DURATION_S = 1e-9
Duration = Annotated[float, Meta(ge=MIN_DURATION_S, le=1e6)]
Hold = Annotated[float, Meta(ge=0.0, le=60.0)]
Reaction = Annotated[float, Meta(ge=0.05, le=60.0)]
StaleAfter = Annotated[float, Meta(ge=1e-9, le=1.0)]
HoldAfter = Annotated[float, Meta(ge=1e-9, le=0.1)]
StopAfter = Annotated[float, Meta(ge=1e-9, le=10.0)]
Extrapolation = Annotated[float, Meta(ge=0.0, le=0.02)]
FadeOut = Annotated[float, Meta(ge=0.05, le=0.1)]
FadeIn = Annotated[float, Meta(ge=0.2, le=60.0)]
SampleRate = Annotated[float, Meta(ge=1e-3, le=1e6)]
Acceleration = Annotated[float, Meta(ge=1e-6, le=LARGEST)]
"""In m/s²; below this a set position would not move within the longest run."""
Period = Annotated[float, Meta(ge=1e-5, le=2e-2)]
AimTime = Annotated[float, Meta(ge=0.001, le=0.4)]
AimStiffness = Annotated[float, Meta(ge=0.0, le=2000.0)]
AimDamping = Annotated[float, Meta(ge=0.0, le=50.0)]
AimStrength = Annotated[float, Meta(ge=0.0, le=50.0)]
TremorFrequency = Annotated[float, Meta(gt=0.0, le=100.0)]
ClockOffset = Annotated[float, Meta(ge=-4e9, le=4e9)]
"""In s: 127 years, as between a set clock and one that was never set."""
ClockDrift = Annotated[float, Meta(ge=-10_000.0, le=10_000.0)]
"""In parts per million; quartz has at most 100."""
ClockStepTime = Annotated[float, Meta(ge=0.0, le=1e9)]
Position = Annotated[float, Meta(ge=-1000.0, le=1000.0)]
"""In m, within the plausible range of the safety layer."""
Speed = Annotated[float, Meta(ge=-1000.0, le=1000.0)]
"""In m/s, within the plausible range of the safety layer."""
Force = Annotated[float, Meta(ge=-10000.0, le=10000.0)]
"""In N, within the plausible range of the safety layer."""
Angle = Annotated[float, Meta(gt=0.0, le=pi)]
"""In rad between two orientations."""
Axis: TypeAlias = Literal[1, 2, 3, 4, 5, 6, 7]
Unbounded: TypeAlias = Literal["unbounded"]
"""Value of a bound that disables it."""
UNBOUNDED = "unbounded"

Broadcast: TypeAlias = Literal["axes", "pairs", "rows"]
"""Broadcast of a value to one per axis: a number or list of numbers; a pair or list of pairs; each row of a list."""
_axes = Meta(min_length=1, max_length=MAX_AXES, extra={"broadcast": "axes"})
PerAxis: TypeAlias = Number | Annotated[tuple[Number, ...], _axes]
"""One number for every axis, or a list of one number per axis."""
PositivePerAxis: TypeAlias = Positive | Annotated[tuple[Positive, ...], _axes]
NonNegativePerAxis: TypeAlias = NonNegative | Annotated[tuple[NonNegative, ...], _axes]
PositionPerAxis: TypeAlias = Position | Annotated[tuple[Position, ...], _axes]
SpeedPerAxis: TypeAlias = Speed | Annotated[tuple[Speed, ...], _axes]
ForcePerAxis: TypeAlias = Force | Annotated[tuple[Force, ...], _axes]
_reach = Annotated[float, Meta(ge=-2.0, le=2.0)]
AimTarget: TypeAlias = _reach | Annotated[tuple[_reach, ...], _axes]
"""In m."""
# Not tuple[Position, Position]: msgspec 0.22 crashes on such a type beside a number with a range.
_pair = Annotated[tuple[Position, ...], Meta(min_length=2, max_length=2)]
StopsPerAxis: TypeAlias = Annotated[
    tuple[Position | _pair, ...], Meta(min_length=1, max_length=MAX_AXES, extra={"broadcast": "pairs"})
]
"""Lower and upper stop for every axis, or one such pair per axis."""
_times = Annotated[tuple[Seconds, ...], Meta(min_length=2, max_length=2)]
Vector3: TypeAlias = Annotated[tuple[Number, ...], Meta(min_length=3, max_length=3)]
"""x, y, z."""
SideKind: TypeAlias = Literal["linear", "joints", "pose"]
"""Kind of a side's coordinates: a point along 1 to 3 axes, 1 to 7 joints, or a point with an orientation."""
Quaternion: TypeAlias = Annotated[tuple[Number, ...], Meta(min_length=4, max_length=4)]
"""Rotation as w, x, y, z."""
AxisIndices: TypeAlias = Annotated[tuple[Annotated[int, Meta(ge=0, le=MAX_AXES - 1)], ...], Meta(max_length=MAX_AXES)]
"""Axis indices from 0."""
ClutchTimes: TypeAlias = tuple[_times, ...]
"""Press and release times in s."""
Opening: TypeAlias = Annotated[float, Meta(ge=0.0, le=1.0)]
"""Opening of a gripper or a trigger: 0 (open) to 1 (closed)."""
TriggerCourse: TypeAlias = tuple[_times, ...]
"""Pairs of time in s and trigger position."""
Options: TypeAlias = dict[str, Any]
"""Keyword arguments of a driver, which validates them itself."""
