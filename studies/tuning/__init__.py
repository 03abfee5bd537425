"""Thresholds from recordings of normal operation: observer boundaries, false trips, missed releases."""

from haptether.studies.tuning.exceedances import Boundary, Exceedances, hours_for
from haptether.studies.tuning.figure import draw_tuning
from haptether.studies.tuning.normal_operation import TUNED_FIELDS, NormalOperation, read_normal_operation
from haptether.studies.tuning.tune import RocPoint, TunedThreshold, Tuning, tune

__all__ = [
    "TUNED_FIELDS",
    "Boundary",
    "Exceedances",
    "NormalOperation",
    "RocPoint",
    "TunedThreshold",
    "Tuning",
    "draw_tuning",
    "hours_for",
    "read_normal_operation",
    "tune",
]
