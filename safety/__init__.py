"""Safety observers, controllers and limits between a remote push and a hand."""

from typing import Literal, TypeAlias

from haptether._core import (
    CONTROLLERS,
    ESTIMATORS,
    OBSERVERS,
    DeviceModel,
    Estimator,
    EstimatorKind,
    HandGraspObserver,
    Intervention,
    Interventions,
    Limiter,
    LimiterSettings,
    PassivityObserver,
    ResearchObservation,
    SafetyController,
    SafetyLayer,
    SafetyObserver,
    SafetySettings,
    SafetyTick,
    SafetyTicks,
    SampleBounds,
    VelocityForceObserver,
    WindowedSafetyObserver,
    fault_message,
)
from haptether.safety.ejection.bound import (
    THROWN_SPEED,
    ControllerBound,
    EjectionBound,
    EjectionSettings,
    EjectionTerms,
    ejection_bound,
    rising_push,
)
from haptether.safety.research import ResearchController, SafetyForce

ControllerName: TypeAlias = Literal["vfc", "hsc", "wsc", "pc"]
"""Names of `CONTROLLERS`, for scenes and type checkers."""

__all__ = [
    "CONTROLLERS",
    "ESTIMATORS",
    "OBSERVERS",
    "THROWN_SPEED",
    "ControllerBound",
    "ControllerName",
    "DeviceModel",
    "EjectionBound",
    "EjectionSettings",
    "EjectionTerms",
    "Estimator",
    "EstimatorKind",
    "HandGraspObserver",
    "Intervention",
    "Interventions",
    "Limiter",
    "LimiterSettings",
    "PassivityObserver",
    "ResearchController",
    "ResearchObservation",
    "SafetyController",
    "SafetyForce",
    "SafetyLayer",
    "SafetyObserver",
    "SafetySettings",
    "SafetyTick",
    "SafetyTicks",
    "SampleBounds",
    "VelocityForceObserver",
    "WindowedSafetyObserver",
    "ejection_bound",
    "fault_message",
    "rising_push",
]
