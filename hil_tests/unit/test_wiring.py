"""The wires between plant and ECUs: each wheel's sensors read the plant, and the Raptor reports them on CAN1."""

from __future__ import annotations

import numpy as np
import pytest

from bridge._native import lib
from bridge.plant import Plant
from bridge.scenario import load_scenario, load_vehicle
from bridge.wiring import Wiring
from dbc.codec import database
from dbc.frames import Bus
from plant_fmu import fmu_path
from scenarios import DIRECTORY
from tools.run import DEFAULT_SCENARIO, build_bench

WHEELS = ("fl", "fr", "rl", "rr")


def test_sensors_of_each_wheel_read_that_wheel():
    with Plant(fmu_path(3), load_vehicle(DIRECTORY / "vehicles" / "av21.yaml")) as plant:
        place = {name: index for index, name in enumerate(plant.output_names)}
        wiring = Wiring(plant)
        quantities = ("wheel_speed", "wheel_load", "tyre_temperature", "tyre_pressure")
        values = {
            f"{quantity}_{wheel}": 10.0 * (row + 1) + column
            for row, quantity in enumerate(quantities)
            for column, wheel in enumerate(WHEELS)
        }
        for name, value in values.items():
            plant.outputs[place[name]] = value
        wiring.sense()
        for quantity in quantities:
            assert list(getattr(wiring.raptor_in, quantity)) == [values[f"{quantity}_{wheel}"] for wheel in WHEELS]
        travel = [values[f"wheel_load_{wheel}"] / 200e3 for wheel in WHEELS]
        assert list(wiring.raptor_in.suspension_travel) == pytest.approx(travel, rel=1e-6)
        assert lib.WIRING_SPRING_RATE == 200_000


def test_the_bus_carries_the_tyre_pressures_of_the_plant():
    with build_bench(load_scenario(DEFAULT_SCENARIO)) as bench:
        for _ in range(40):
            bench.tick()
        truth = dict(zip(bench.plant.output_names, bench.plant.outputs, strict=True))
        frames = bench.network.log_view()
        for wheel in WHEELS:
            message = database.message(f"Tire_Pressure_{wheel.upper()}")
            sent = frames[(frames["bus"] == Bus.CAN1) & (frames["id"] == message.frame_id)]
            assert len(sent) == pytest.approx(4, abs=1), "every 100 ms"
            absolute, above_ambient = message.decode(bytes(sent[-1]["data"]))
            assert absolute == pytest.approx(truth[f"tyre_pressure_{wheel}"] / 100.0, abs=1.0), "mbar"
            assert absolute - above_ambient == pytest.approx(1013.0, abs=1.0)
        potentiometer = database.message("wheel_potentiometer_data")
        sent = frames[(frames["bus"] == Bus.CAN1) & (frames["id"] == potentiometer.frame_id)]
        travel = np.array(potentiometer.decode(bytes(sent[-1]["data"])))
        loads = np.array([truth[f"wheel_load_{wheel}"] for wheel in ("fl", "fr", "rr", "rl")])
        assert travel * 1e-3 == pytest.approx(loads / 200e3, abs=2e-5)
