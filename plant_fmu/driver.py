"""Drive one plant FMU from Python: for tests, tuning and examples, not for speed.

with Plant(parameters={"v0": 20.0}) as car:
    car.step(1.0, throttle_demand=0.3)
    print(car["vx"])
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import fmpy.fmi2
import fmpy.fmi3

from plant_fmu import fmu_path

Value = float | int | bool

_fmpy: Any = fmpy
"""fmpy without its type hints, which cover only a part of it."""


def read_description(path: Path) -> Any:
    """Return fmpy's model description of an FMU."""
    return _fmpy.read_model_description(str(path))


class Plant:
    """One instance of the plant, initialised and ready to step.

    `parameters` are set before initialization and may hold inputs too; unknown names raise
    KeyError. `step_s` is the communication step.
    """

    def __init__(
        self,
        parameters: Mapping[str, Value] | None = None,
        *,
        fmi_version: int = 3,
        step_s: float = 0.01,
        path: Path | None = None,
        start_time: float = 0.0,
    ) -> None:
        fmu = path if path is not None else fmu_path(fmi_version)
        self.description = read_description(fmu)
        self.fmi_version = 3 if self.description.fmiVersion.startswith("3") else 2
        self.step_s = step_s
        self.start_time = start_time
        self.messages: list[str] = []
        self._folder = str(_fmpy.extract(str(fmu)))
        self._types = {v.name: v.type for v in self.description.modelVariables}
        self._references = {v.name: v.valueReference for v in self.description.modelVariables}
        arguments: dict[str, Any] = {
            "unzipDirectory": self._folder,
            "modelIdentifier": self.description.coSimulation.modelIdentifier,
            "instanceName": "car",
        }
        if self.fmi_version == 3:
            self.fmu: Any = _fmpy.fmi3.FMU3Slave(guid=self.description.instantiationToken, **arguments)
            self.fmu.instantiate(logMessage=self._log3)
        else:
            self.fmu = _fmpy.fmi2.FMU2Slave(guid=self.description.guid, **arguments)
            self.fmu.instantiate()
        self.initialise(parameters)

    def _log3(self, _environment: Any, _status: int, _category: bytes, message: bytes) -> None:
        self.messages.append(message.decode())

    def initialise(self, parameters: Mapping[str, Value] | None = None) -> None:
        """Go through initialization mode with `parameters`."""
        self._steps = 0
        for name, value in (parameters or {}).items():
            self[name] = value
        if self.fmi_version == 3:
            self.fmu.enterInitializationMode(startTime=self.start_time)
        else:
            self.fmu.setupExperiment(startTime=self.start_time)
            self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def reset(self, parameters: Mapping[str, Value] | None = None) -> None:
        """Reset the instance and initialise it again."""
        self.fmu.reset()
        self.initialise(parameters)

    @property
    def time(self) -> float:
        """Communication time in seconds."""
        return self.start_time + self._steps * self.step_s

    @time.setter
    def time(self, value: float) -> None:
        self._steps = round((value - self.start_time) / self.step_s)

    def names(self, causality: str) -> list[str]:
        """Names of the variables with a causality, in value reference order."""
        return [v.name for v in self.description.modelVariables if v.causality == causality]

    def __getitem__(self, name: str) -> Value:
        reference = [self._references[name]]
        kind = self._types[name]
        if kind in ("Real", "Float64"):
            values = self.fmu.getFloat64(reference) if kind == "Float64" else self.fmu.getReal(reference)
            return float(values[0])
        if kind == "Boolean":
            return bool(self.fmu.getBoolean(reference)[0])
        values = self.fmu.getInt32(reference) if kind == "Int32" else self.fmu.getInteger(reference)
        return int(values[0])

    def __setitem__(self, name: str, value: Value) -> None:
        reference = [self._references[name]]
        kind = self._types[name]
        if kind == "Float64":
            self.fmu.setFloat64(reference, [float(value)])
        elif kind == "Real":
            self.fmu.setReal(reference, [float(value)])
        elif kind == "Boolean":
            self.fmu.setBoolean(reference, [bool(value)])
        elif kind == "Int32":
            self.fmu.setInt32(reference, [int(value)])
        else:
            self.fmu.setInteger(reference, [int(value)])

    def step(self, duration_s: float | None = None, **inputs: Value) -> None:
        """Set inputs, then advance by `duration_s` (default one step) in communication steps."""
        for name, value in inputs.items():
            self[name] = value
        count = 1 if duration_s is None else round(duration_s / self.step_s)
        for _ in range(count):
            self.fmu.doStep(self.time, self.step_s)
            self._steps += 1

    def outputs(self) -> dict[str, Value]:
        """All outputs."""
        return {name: self[name] for name in self.names("output")}

    def close(self) -> None:
        """Free the instance and remove the unpacked FMU."""
        if self._folder:
            self.fmu.freeInstance()
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = ""

    def __enter__(self) -> Plant:
        return self

    def __exit__(
        self,
        _type: type[BaseException] | None,
        _value: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self.close()
