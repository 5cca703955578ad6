"""Wires between the plant and the two actuator ECUs, and the person at the switches.

The conversion is C (``bridge/native/wiring.c``) on arrays that are shared with the plant, so it costs one call.
"""

from __future__ import annotations

from typing import Any

from bridge._native import ffi, lib
from bridge.plant import REQUIRED_INPUTS, Plant

#: Grip of the road as the tyres of the plant know it, and the input that says so.
NOMINAL_FRICTION = 1.0
PLACE_OF_FRICTION = REQUIRED_INPUTS.index("road_friction")


class Wiring:
    """The wired structs of Raptor and Space Drive, joined to one plant.

    Parameters
    ----------
    plant : its arrays are wired.

    Attributes
    ----------
    raptor_in, raptor_out, space_drive_in, space_drive_out : the C structs that the ECUs read and write.
    """

    def __init__(self, plant: Plant) -> None:
        self.raptor_in: Any = ffi.new("raptor_wired_in *")
        self.raptor_out: Any = ffi.new("raptor_wired_out *")
        self.space_drive_in: Any = ffi.new("space_drive_wired_in *")
        self.space_drive_out: Any = ffi.new("space_drive_wired_out *")
        self.raptor_in.mode_switch = True
        self._inputs = ffi.from_buffer("double[]", plant.inputs, require_writable=True)
        self._outputs = ffi.from_buffer("double[]", plant.outputs)
        plant.inputs[PLACE_OF_FRICTION] = NOMINAL_FRICTION

    def sense(self) -> None:
        """Plant outputs to the ECUs' inputs."""
        lib.wiring_sense(self._outputs, self.raptor_in, self.space_drive_in)

    def drive(self) -> None:
        """ECUs' outputs to the plant's inputs."""
        lib.wiring_drive(self.raptor_out, self.space_drive_out, self._inputs)

    def release_raptor(self) -> None:
        """Let the Raptor's outputs fall off, as without power: throttle closed, ignition and starter off."""
        ffi.memmove(self.raptor_out, bytes(ffi.sizeof("raptor_wired_out")), ffi.sizeof("raptor_wired_out"))

    def lay_road(self, bank: float, grade: float) -> None:
        """Put the road under the car; rad."""
        self._inputs[lib.PLANT_IN_ROAD_BANK] = bank
        self._inputs[lib.PLANT_IN_ROAD_GRADE] = grade
