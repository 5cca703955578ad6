"""Fault injection: what goes wrong, when, and what came of it. See docs/injection.md."""

from bridge.faults.car import ActuatorStuck, BrakeFade, EngineStall, GripLoss
from bridge.faults.ecus import Hang, PowerLoss, Reset, Slow
from bridge.faults.fault import BenchFault, Fault, FrameFault, InputFault
from bridge.faults.frames import (
    Babble,
    BusError,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    Late,
    Replay,
    Silent,
    WrongIdentifier,
    WrongLength,
)
from bridge.faults.injector import Injection
from bridge.faults.plan import FaultPlan, Onset
from bridge.faults.signals import (
    Freeze,
    GnssBias,
    HeartbeatStalled,
    Noise,
    Offset,
    ParameterAltered,
    Scale,
    SensorFrozen,
    SensorOutage,
    StatusCode,
    Stuck,
)

__all__ = [
    "ActuatorStuck",
    "Babble",
    "BenchFault",
    "BrakeFade",
    "BusError",
    "Corrupt",
    "Delay",
    "Drop",
    "Duplicate",
    "EngineStall",
    "Fault",
    "FaultPlan",
    "FrameFault",
    "Freeze",
    "GnssBias",
    "GripLoss",
    "Hang",
    "HeartbeatStalled",
    "Injection",
    "InputFault",
    "Late",
    "Noise",
    "Offset",
    "Onset",
    "ParameterAltered",
    "PowerLoss",
    "Replay",
    "Reset",
    "Scale",
    "SensorFrozen",
    "SensorOutage",
    "Silent",
    "Slow",
    "StatusCode",
    "Stuck",
    "WrongIdentifier",
    "WrongLength",
]
