"""Faults of the car: what gets from the wires to the plant, and the road under it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bridge.faults.fault import InputFault, Memory, parameter
from bridge.plant import REQUIRED_INPUTS, WHEELS

#: Inputs of the plant by actuator.
ACTUATORS = {
    "steering": REQUIRED_INPUTS.index("steer_motor_demand"),
    "brake": REQUIRED_INPUTS.index("brake_pressure_demand"),
    "throttle": REQUIRED_INPUTS.index("throttle_demand"),
    "gear": REQUIRED_INPUTS.index("gear_demand"),
}
_IGNITION = REQUIRED_INPUTS.index("ignition")
_FRICTION = REQUIRED_INPUTS.index("road_friction")


@dataclass(frozen=True, kw_only=True)
class ActuatorStuck(InputFault):
    """An actuator goes for one demand whatever it is told.

    Attributes
    ----------
    value : rad at the steering motor, Pa, 0 to 1 of the throttle, or the gear; by default what it was last told.
    """

    kind = "actuator_stuck"
    actuator: str = parameter(enum=list(ACTUATORS))
    value: float | None = parameter(default=None)

    def drive(self, inputs: NDArray[np.float64], memory: Memory) -> None:
        place = ACTUATORS[self.actuator]
        if memory.number == 0:
            memory.kept["value"] = float(inputs[place]) if self.value is None else self.value
        inputs[place] = memory.kept["value"]


@dataclass(frozen=True, kw_only=True)
class BrakeFade(InputFault):
    """The brakes reach only a share of the pressure that they are asked for."""

    kind = "brake_fade"
    factor: float = parameter(minimum=0, exclusiveMaximum=1)

    def drive(self, inputs: NDArray[np.float64], memory: Memory) -> None:
        inputs[ACTUATORS["brake"]] *= self.factor


@dataclass(frozen=True, kw_only=True)
class EngineStall(InputFault):
    """The engine gets no spark."""

    kind = "engine_stall"

    def drive(self, inputs: NDArray[np.float64], memory: Memory) -> None:
        inputs[_IGNITION] = 0.0


@dataclass(frozen=True, kw_only=True)
class GripLoss(InputFault):
    """All four tyres, or one, have a share of their grip: water, oil, marbles. The plant takes no less than 0.01."""

    kind = "grip_loss"
    factor: float = parameter(minimum=0.01, exclusiveMaximum=1)
    wheel: str | None = parameter(default=None, enum=list(WHEELS))

    @property
    def needed_inputs(self) -> tuple[str, ...]:
        return () if self.wheel is None else (f"wheel_grip_{self.wheel}",)

    def drive(self, inputs: NDArray[np.float64], memory: Memory) -> None:
        place = _FRICTION if self.wheel is None else len(REQUIRED_INPUTS) + WHEELS.index(self.wheel)
        inputs[place] *= self.factor
