"""The plant: a co-simulation FMU, FMI 2 or 3, stepped through fmpy's bindings with arrays allocated once.

Any FMU will do that has the inputs and outputs named by the enums in ``bridge/native/wiring.h``, whatever their
numeric types are.
"""

from __future__ import annotations

import ctypes
import shutil
import zipfile
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir, suppress
from functools import partial
from itertools import count, groupby
from pathlib import Path
from types import TracebackType
from typing import Any
from weakref import WeakSet, WeakValueDictionary, finalize
from xml.etree import ElementTree

import fmpy
import numpy as np
from fmpy import fmi2, fmi3
from fmpy.fmi1 import FMICallException
from fmpy.logging import addLoggerProxy
from fmpy.model_description import ModelVariable
from numpy.typing import NDArray

from bridge._native import lib
from dbc.errors import PlantError, StartValueError


def _names(prefix: str) -> tuple[str, ...]:
    """Plant variables named by the enumerators of wiring.h, in their order."""
    found = {name: getattr(lib, name) for name in dir(lib) if name.startswith(prefix) and not name.endswith("_COUNT")}
    return tuple(name.removeprefix(prefix).lower() for name in sorted(found, key=lambda name: int(found[name])))


#: Outputs that the bench needs; they come first in `Plant.outputs`, in the order of ``enum plant_output``.
REQUIRED_OUTPUTS = _names("PLANT_OUT_")
#: Inputs that the bench drives, in the order of ``enum plant_input``.
REQUIRED_INPUTS = _names("PLANT_IN_")

#: Grip under each wheel as a share of the road's: an FMU that has all four gets them, behind those that it must have.
WHEELS = ("fl", "fr", "rl", "rr")
OPTIONAL_INPUTS = tuple(f"wheel_grip_{wheel}" for wheel in WHEELS)

#: FMI types that carry one number, with their C types.
_NUMBERS: Mapping[str, Any] = {
    "Real": ctypes.c_double,
    "Integer": ctypes.c_int,
    "Float64": ctypes.c_double,
    "Float32": ctypes.c_float,
    "Int8": ctypes.c_int8,
    "UInt8": ctypes.c_uint8,
    "Int16": ctypes.c_int16,
    "UInt16": ctypes.c_uint16,
    "Int32": ctypes.c_int32,
    "UInt32": ctypes.c_uint32,
    "Int64": ctypes.c_int64,
    "UInt64": ctypes.c_uint64,
    "Boolean": None,  # int in FMI 2, bool in FMI 3
}


#: Worst status with which a result may be used.
_WARNING = 1


def _checked(fmu: Any, name: str, *arguments: Any) -> Callable[..., None]:
    """A call of the FMU that raises FMICallException when its status is worse than a warning.

    fmpy's own wrapper does the same, and looks up and logs each call besides, which costs more than the call.
    """
    call = partial(getattr(fmu.dll, name), *arguments)

    def checked(*more: Any) -> None:
        status = call(*more)
        if status > _WARNING:
            raise FMICallException(function=name, status=status)

    return checked


class _Run:
    """Variables of one FMI type side by side in an array of doubles, set or got in one call.

    Doubles go straight from and to the array; other types by way of a buffer of theirs.
    """

    def __init__(
        self, fmu: Any, call: str, variables: Sequence[ModelVariable], values: NDArray[np.float64], place: int
    ) -> None:
        is_fmi2 = isinstance(fmu, fmi2.FMU2Slave)
        fmi_type, count = variables[0].type, len(variables)
        number = _NUMBERS[fmi_type] or (ctypes.c_int if is_fmi2 else ctypes.c_bool)
        references = (ctypes.c_uint * count)(*(variable.valueReference for variable in variables))
        self._array = values[place : place + count]
        self._buffer: NDArray[Any] | None = None
        passed: Any
        if number is ctypes.c_double:
            passed = self._array.ctypes.data_as(ctypes.POINTER(number))
        else:
            passed = (number * count)()
            self._buffer = np.ctypeslib.as_array(passed)
        name = f"fmi{2 if is_fmi2 else 3}{call}{fmi_type}"
        self._call = _checked(fmu, name, fmu.component, references, count, passed, *(() if is_fmi2 else (count,)))

    def set(self) -> None:
        if self._buffer is not None:
            self._buffer[:] = self._array
        self._call()

    def get(self) -> None:
        self._call()
        if self._buffer is not None:
            self._array[:] = self._buffer


# fmpy's logger proxy keeps one FMI 2 callback for the whole process, and calls it for every instance ever made: it has
# to outlive them all, and find out by name whose message it is.
_NUMBERS_OF_INSTANCES = count()
_MESSAGES: WeakValueDictionary[bytes, deque[str]] = WeakValueDictionary()


def _log_fmi2(_environment: Any, name: bytes, _status: int, _category: bytes, message: bytes) -> None:
    messages = _MESSAGES.get(name)
    if messages is not None:
        messages.append(message.decode("utf-8", "replace"))


_LOGGER = fmi2.fmi2CallbackLoggerTYPE(_log_fmi2)


class PlantState:
    """State of an FMU, freed with this object.

    Attributes
    ----------
    inputs, outputs : of the plant at that time.
    free : gives it back to the FMU; to be called at the latest before the FMU is freed, safe to call twice.
    """

    def __init__(self, fmu: Any, inputs: NDArray[np.float64], outputs: NDArray[np.float64], is_fmi3: bool) -> None:
        self.inputs, self.outputs = inputs, outputs
        self._set = fmu.setFMUState if is_fmi3 else fmu.setFMUstate
        self._state = (fmu.getFMUState if is_fmi3 else fmu.getFMUstate)()
        self.free = finalize(self, fmu.freeFMUState if is_fmi3 else fmu.freeFMUstate, self._state)

    def restore(self) -> None:
        """Set the FMU to it.

        Raises
        ------
        PlantError
            When it was freed.
        """
        if not self.free.alive:
            raise PlantError("the plant is closed; its saved states are gone")
        self._set(self._state)


class Plant:
    """One instance of an FMU, initialised and ready to step.

    Parameters
    ----------
    path : the ``.fmu`` file.
    start : start values by variable name, SI units.
    required_outputs, required_inputs : variables that the FMU must have.

    Attributes
    ----------
    inputs : shape (len(input_names),); write before `step`.
    input_names : the required inputs, then those of `OPTIONAL_INPUTS` if the FMU has them all.
    outputs : shape (len(output_names),); valid after construction and after each `step`.
    output_names, output_units : the required outputs first, then all other numeric outputs of the FMU.

    Raises
    ------
    StartValueError
        When the FMU lacks a variable of `start` or refuses a value.
    PlantError
        When the file is missing or no co-simulation FMU, or lacks a required variable.
    """

    def __init__(
        self,
        path: Path,
        start: Mapping[str, float],
        required_outputs: Sequence[str] = REQUIRED_OUTPUTS,
        required_inputs: Sequence[str] = REQUIRED_INPUTS,
    ) -> None:
        self._path = path
        self._folder: str | None = None
        self._states: WeakSet[PlantState] = WeakSet()
        self._name = f"plant {next(_NUMBERS_OF_INSTANCES)}"
        self._messages: deque[str] = deque(maxlen=1)
        _MESSAGES[self._name.encode()] = self._messages
        description = _read_description(path)
        self._fmi3 = description.fmiVersion.startswith("3")
        self._gives_state = bool(description.coSimulation.canGetAndSetFMUstate)
        variables = {variable.name: variable for variable in description.modelVariables}
        optional = OPTIONAL_INPUTS if variables.keys() >= set(OPTIONAL_INPUTS) else ()
        self.input_names = (*required_inputs, *optional)
        inputs = [self._variable(variables, name, "input") for name in self.input_names]
        outputs = [self._variable(variables, name, "output") for name in required_outputs]
        outputs += [
            variable
            for variable in description.modelVariables
            if variable.causality == "output" and _is_number(variable) and variable.name not in required_outputs
        ]
        for name in start:
            if name not in variables:
                raise StartValueError(f"{path}: has no variable {name!r}, which is given a start value")
        starts = [(self._variable(variables, name, "parameter"), value) for name, value in start.items()]
        self.output_names = tuple(variable.name for variable in outputs)
        self.output_units = tuple(variable.unit or "" for variable in outputs)
        self.inputs: NDArray[np.float64] = np.array([_start_value(variable) for variable in inputs])
        self.outputs: NDArray[np.float64] = np.zeros(len(outputs))
        try:
            self._fmu = self._load(description)
            self._do_step = self._make_step()
            for run in self._runs(
                "Set", [variable for variable, _ in starts], np.array([value for _, value in starts])
            ):
                run.set()
            self._initialise()
            self._setters = self._runs("Set", inputs, self.inputs)
            self._getters = self._runs("Get", outputs, self.outputs)
            for run in self._getters:
                run.get()
        except FMICallException as error:
            self._discard()
            raise StartValueError(self._failed("cannot be initialised", error)) from error
        except PlantError:
            self._discard()
            raise
        except Exception as error:  # fmpy raises bare Exception for a library that does not load
            self._discard()
            raise PlantError(f"{path}: cannot be loaded: {_one_line(error)}") from error

    def __enter__(self) -> Plant:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def step(self, time_s: float, step_s: float) -> None:
        """Set the inputs, advance from `time_s` by `step_s`, get the outputs.

        Raises
        ------
        PlantError
            When the FMU reports an error, with its last message.
        """
        try:
            for run in self._setters:
                run.set()
            self._do_step(time_s, step_s)
            for run in self._getters:
                run.get()
        except FMICallException as error:
            raise self._failed(f"failed at {time_s:.2f} s", error) from error

    def save_state(self) -> PlantState:
        """State of the FMU with inputs and outputs, see `bridge.saved_state`.

        Raises
        ------
        PlantError
            When the FMU cannot give its state.
        """
        if not self._gives_state:
            raise PlantError(f"{self._path}: its state cannot be saved: it says no canGetAndSetFMUstate")
        try:
            state = PlantState(self._fmu, self.inputs.copy(), self.outputs.copy(), self._fmi3)
        except FMICallException as error:
            raise self._failed("its state cannot be saved", error) from error
        self._states.add(state)
        return state

    def restore_state(self, state: PlantState) -> None:
        """Go on from there."""
        try:
            state.restore()
        except FMICallException as error:
            raise self._failed("its state cannot be restored", error) from error
        self.inputs[:], self.outputs[:] = state.inputs, state.outputs

    def close(self) -> None:
        """End the instance and remove its unpacked files; safe to call twice."""
        if self._folder is not None:
            with suppress(FMICallException):
                self._fmu.terminate()
            self._discard()

    def _variable(self, variables: Mapping[str, ModelVariable], name: str, causality: str) -> ModelVariable:
        variable = variables.get(name)
        if variable is None:
            raise PlantError(f"{self._path}: has no variable {name!r}, which is needed as {causality}")
        # A start value may be set on any variable; inputs and outputs must be what they are called.
        if not _is_number(variable) or causality not in ("parameter", variable.causality):
            raise PlantError(
                f"{self._path}: variable {name!r} is a {variable.type} {variable.causality}; "
                f"needed is one number as {causality}"
            )
        return variable

    def _load(self, description: Any) -> Any:
        co_simulation = description.coSimulation
        self._folder = fmpy.extract(str(self._path))
        options = {
            "guid": description.instantiationToken if self._fmi3 else description.guid,
            "modelIdentifier": co_simulation.modelIdentifier,
            "unzipDirectory": self._folder,
            "instanceName": self._name,
        }
        with chdir(Path.cwd()):  # fmpy goes to the library's folder, and stays there when it does not load
            fmu = fmi3.FMU3Slave(**options) if self._fmi3 else fmi2.FMU2Slave(**options)
        if self._fmi3:
            fmu.instantiate(logMessage=self._log_fmi3, loggingOn=True)
        else:
            callbacks = fmi2.fmi2CallbackFunctions()
            callbacks.logger = _LOGGER
            callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmi2.calloc)
            callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmi2.free)
            addLoggerProxy(ctypes.byref(callbacks))  # expands printf formats before the callback sees them
            fmu.instantiate(callbacks=callbacks, loggingOn=True)
        return fmu

    def _initialise(self) -> None:
        if not self._fmi3:
            self._fmu.setupExperiment(startTime=0.0)
            self._fmu.enterInitializationMode()
        else:
            self._fmu.enterInitializationMode(startTime=0.0)
        self._fmu.exitInitializationMode()

    def _make_step(self) -> Callable[[float, float], None]:
        component = self._fmu.component
        if not self._fmi3:
            step2 = _checked(self._fmu, "fmi2DoStep", component)

            def do_step_fmi2(time_s: float, step_s: float) -> None:
                step2(time_s, step_s, 1)

            return do_step_fmi2
        step3 = _checked(self._fmu, "fmi3DoStep", component)
        event, terminate, early = ctypes.c_bool(), ctypes.c_bool(), ctypes.c_bool()
        last = ctypes.c_double()
        results = tuple(ctypes.byref(value) for value in (event, terminate, early, last))

        def do_step_fmi3(time_s: float, step_s: float) -> None:
            step3(time_s, step_s, True, *results)
            if terminate.value:
                raise PlantError(f"{self._path}: the FMU ended the simulation at {last.value:.2f} s")

        return do_step_fmi3

    def _runs(self, call: str, variables: Sequence[ModelVariable], values: NDArray[np.float64]) -> list[_Run]:
        runs, place = [], 0
        for _, same in groupby(variables, key=lambda variable: str(variable.type)):
            members = list(same)
            runs.append(_Run(self._fmu, call, members, values, place))
            place += len(members)
        return runs

    def _log_fmi3(self, _environment: Any, _status: int, _category: bytes, message: bytes) -> None:
        self._messages.append(message.decode("utf-8", "replace"))

    def _failed(self, what: str, error: FMICallException) -> PlantError:
        reason = self._messages[-1] if self._messages else f"{error.function} returned status {error.status}"
        return PlantError(f"{self._path}: {what}: {_one_line(reason)}")

    def _discard(self) -> None:
        for state in list(self._states):
            state.free()
        fmu = getattr(self, "_fmu", None)
        if fmu is not None and fmu.component:
            fmu.freeInstance()
            fmu.component = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None


def _read_description(path: Path) -> Any:
    if not path.is_file():
        raise PlantError(f"{path}: no such FMU file")
    if not zipfile.is_zipfile(path):
        raise PlantError(f"{path}: not an FMU: no ZIP archive")
    try:
        with zipfile.ZipFile(path) as archive:
            version = ElementTree.fromstring(archive.read("modelDescription.xml")).get("fmiVersion", "unknown")
        if not version.startswith(("2.", "3.")):
            raise PlantError(f"{path}: FMI {version}; allowed are FMI 2 and 3")
        with path.open("rb") as file:  # fmpy would leave a broken one open
            description = fmpy.read_model_description(file, validate=False)
    except PlantError:
        raise
    except Exception as error:  # a broken archive or XML ends in many types; the user needs the file and a reason
        raise PlantError(f"{path}: not an FMU: {_one_line(error)}") from error
    if description.coSimulation is None:
        raise PlantError(f"{path}: no co-simulation FMU; only co-simulation can be stepped")
    return description


def _is_number(variable: ModelVariable) -> bool:
    return variable.type in _NUMBERS and not variable.dimensions


def _start_value(variable: ModelVariable) -> float:
    if variable.type == "Boolean":
        return 1.0 if variable.start in {"true", "1"} else 0.0
    return float(variable.start or 0.0)


def _one_line(reason: object) -> str:
    return " ".join(str(reason).split()) or type(reason).__name__
