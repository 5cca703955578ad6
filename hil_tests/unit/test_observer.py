"""Order of time over several buses, and the load of a bus from its frames."""

from __future__ import annotations

import numpy as np
import pytest

from bridge.bench import TICK_US
from bridge.realtime.bus_load import BusLoad
from bridge.realtime.observer import InOrder, Observer
from bridge.scenario import load_scenario
from dbc.buses import car_buses
from dbc.frames import FRAME_DTYPE, Bus
from tools.run import DEFAULT_SCENARIO, build_bench


def frames(bus: int, *times: int) -> np.ndarray:
    made = np.zeros(len(times), FRAME_DTYPE)
    made["time_us"] = times
    made["bus"] = bus
    made["dlc"] = 8
    return made


def rows(taken: np.ndarray) -> list[tuple[int, int]]:
    return [(int(frame["time_us"]), int(frame["bus"])) for frame in taken]


def test_frames_of_two_buses_come_in_order_of_time():
    order = InOrder()
    order.add(frames(0, 10, 30))
    order.add(frames(1, 20, 40))
    assert rows(order.take(35)) == [(10, 0), (20, 1), (30, 0)]
    order.add(frames(0))
    order.add(frames(1, 36))
    assert rows(order.take(40)) == [(36, 1)], "a frame of the time itself is not given out yet"
    assert rows(order.take()) == [(40, 1)]
    assert rows(order.take()) == []
    assert order.late == 0


def test_frames_of_one_time_keep_their_order():
    order = InOrder()
    first = frames(0, 5, 5, 5)
    first["id"] = [3, 1, 2]
    order.add(first)
    assert list(order.take(6)["id"]) == [3, 1, 2]


def test_a_frame_that_comes_too_late_is_counted_and_not_lost():
    order = InOrder()
    order.add(frames(0, 10, 50))
    assert rows(order.take(60)) == [(10, 0), (50, 0)]
    order.add(frames(1, 20, 49, 50, 55))
    assert rows(order.take(60)) == [(20, 1), (49, 1), (50, 1), (55, 1)]
    assert order.late == 2


@pytest.mark.parametrize("seed", range(5))
def test_pieces_of_any_size_give_the_whole_in_order(seed: int):
    print(f"seed {seed}")
    generator = np.random.default_rng(seed)
    times = [np.sort(generator.integers(0, 100_000, 300)) for _ in range(4)]
    order = InOrder()
    taken = []
    for now in range(0, 130_000, 5_000):
        # Every bus delivers with a delay of its own, below what is kept back.
        delays = generator.integers(0, 20_000, 4)
        for bus in range(4):
            arrived = times[bus] <= now - delays[bus]
            order.add(frames(bus, *times[bus][arrived]))
            times[bus] = times[bus][~arrived]
        taken.append(order.take(now - 30_000))
    taken.append(order.take())
    whole = np.concatenate(taken)
    assert whole.size == 4 * 300 - sum(rest.size for rest in times)
    assert np.all(np.diff(whole["time_us"].astype(np.int64)) >= 0)
    assert order.late == 0


@pytest.mark.parametrize("chunk", [1, 7, 1 << 20])
def test_load_is_that_of_the_bus_model(chunk: int):
    """The in-process buses count bit by bit; from their log alone, in chunks of any size, the same must come out."""
    ticks = 200 if chunk > 1 else 40
    with build_bench(load_scenario(DEFAULT_SCENARIO)) as bench:
        pieces = []
        for _ in range(ticks):
            bench.tick()
            pieces.append(bench.network.drain_log())
        expected = bench.network.statistics()
        log = np.concatenate(pieces)
    load = BusLoad()
    for first in range(0, log.size, chunk):
        load.update(log[first : first + chunk])
    found = load.statistics(ticks * TICK_US * 1e-6)
    for bus in car_buses():
        assert found[bus]["bit_rate"] in (500_000, 1_000_000)
        assert found[bus]["frames"] == expected[bus].frames > 0
        assert found[bus]["frames_per_s"] == pytest.approx(expected[bus].frames / (ticks * 0.01))
        assert found[bus]["load"] == pytest.approx(expected[bus].load, rel=1e-12)
        assert found[bus]["load_peak"] == pytest.approx(expected[bus].load_peak, rel=1e-12)


def test_load_of_a_silent_bus_is_zero():
    load = BusLoad()
    load.update(frames(Bus.CAN1))
    load.update(frames(Bus.CAN_S, 3_000_000))
    found = load.statistics(10.0)
    assert (found[Bus.CAN1]["frames"], found[Bus.CAN1]["load"], found[Bus.CAN1]["load_peak"]) == (0, 0.0, 0.0)
    assert found[Bus.CAN_S]["frames"] == 1
    assert found[Bus.CAN_S]["load_peak"] == pytest.approx(found[Bus.CAN_S]["load"] * 1000)


def test_frames_get_the_time_of_a_car_that_lives_slower():
    class Ear:
        def __init__(self) -> None:
            self.heard = [frames(Bus.CAN1, 30, 75), frames(Bus.CAN1, 160)]

        def receive(self) -> np.ndarray:
            return self.heard.pop(0) if self.heard else frames(Bus.CAN1)

    recorded: list[np.ndarray] = []
    observer = Observer([Ear()], recorded.append, slower=5)
    observer.poll(0)
    observer.finish()
    assert [rows(taken) for taken in recorded] == [[(6, 0), (15, 0), (32, 0)]]
