"""Safety observers, controllers and limits that stand between a remote push and a hand."""

from haptether._core import (
    DeviceModel,
    Estimator,
    EstimatorKind,
    HandGraspObserver,
    Intervention,
    Interventions,
    Limiter,
    LimiterSettings,
    PassivityObserver,
    SafetyController,
    SafetyObserver,
    SafetySettings,
    VelocityForceObserver,
    WindowedSafetyObserver,
    fault_message,
)

__all__ = [
    "DeviceModel",
    "Estimator",
    "EstimatorKind",
    "HandGraspObserver",
    "Intervention",
    "Interventions",
    "Limiter",
    "LimiterSettings",
    "PassivityObserver",
    "SafetyController",
    "SafetyObserver",
    "SafetySettings",
    "VelocityForceObserver",
    "WindowedSafetyObserver",
    "fault_message",
]
