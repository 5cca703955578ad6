"""What tables, pictures and files show of measurements: the right numbers, the right words, in 80 columns."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from jitter_samples import EPOCH_NS, cycle_log, frames_after, measurement, records
from rich.console import Console

from dbc.errors import RaceloopError
from dbc.frames import Bus
from tools.jitter.figures import Distribution
from tools.jitter.machine import look_at_machine
from tools.jitter.measurement import Cycles, Measurement
from tools.jitter.report import WIDTH, as_json, picture, show, targets
from tools.output_files import write_json


def page(*measurements: Measurement) -> list[str]:
    console = Console(width=80, highlight=False, color_system=None)
    with console.capture() as captured:
        show(measurements, console)
    return captured.get().splitlines()


def rows(lines: list[str], title: str) -> list[list[str]]:
    """Lines below a title of the table, split at two or more spaces or before numbers."""
    start = lines.index(title) + 1
    out = []
    for line in lines[start:]:
        if not line.startswith("  "):
            break
        out.append([line[:27].strip(), *line[27:].split()])
    return out


def test_table_holds_every_quantity_of_every_condition():
    lines = page(measurement(2000), measurement(2000, "cpu load", 4712))
    assert rows(lines, "Wake-up lateness")[:6] == [
        ["raceloop-obc", "idle", *["60.0"] * 6, "0.000"],
        ["", "cpu", "load", *["60.0"] * 6, "0.000"],
        ["waiting for the core", "idle", "0.0", *["25.0"] * 5, "0.022"],
        ["", "cpu", "load", "0.0", *["25.0"] * 5, "0.022"],
        ["cyclictest", "idle", "50.0", "50.0", "50.0", "50.0", "50.0", "90.0", "0.018"],
        ["", "cpu", "load", "50.0", "50.0", "50.0", "50.0", "50.0", "90.0", "0.018"],
    ]
    assert rows(lines, "Age of input when brake_pressure_cmd is sent")[0][:3] == [
        "from CAN-S (sensors)",
        "idle",
        "3230",
    ]
    assert rows(lines, "Spacing error of brake_pressure_cmd")[2][:3] == ["plain Python loop", "idle", "100.0"]


def test_page_fits_eighty_columns():
    for line in page(measurement(), measurement(condition="memory load", process=4712)):
        assert len(line) <= WIDTH, line


def test_figures_from_too_few_samples_are_not_shown():
    (ours, *_) = rows(page(measurement(50)), "Wake-up lateness")
    assert ours == ["raceloop-obc", "60.0", "60.0", "60.0", "-", "-", "60.0", "0.000"]


def test_histograms_stand_in_columns():
    lines = page(measurement(2000))
    start = len(lines) - 1 - lines[::-1].index("Wake-up lateness")
    axis, ours, machine = lines[start - 1], lines[start + 1], lines[start + 2]
    assert axis.index("|1 us") == 28
    decade = axis.index("|10 ")
    assert ours.index("█") == decade + int(8 * np.log10(6.0))
    assert machine.index("█") == decade + int(8 * np.log10(5.0))


def test_worst_cycles_are_named_with_what_ran_in_them():
    lines = page(measurement())
    start = lines.index("  worst cycles, us from the deadline to the last frame with the kernel:")
    assert lines[start + 1] == "    cycle 7 at 0.074 s on core 0: 1260, mostly off the core"
    assert lines[start + 2] == "      timer 60, waiting 0, program 150, off the core 1050 (preemptions: 2)"
    assert lines[start + 3] == "      tasks: receive 30, monitor 60"


@pytest.mark.parametrize(
    ("late", "rationed"),
    [([3, 13, 23, 33, 43], True), ([3, 13, 23, 33, 44], False), ([3, 13, 23, 33], False)],
)
def test_a_host_that_rations_processors_is_recognised(late: list[int], rationed: bool):
    cycles = records(50)
    for field in ("wake_ns", "received_ns", "ticked_ns", "sent_ns"):
        cycles[field][late] += 3_000_000
    lines = page(replace(measurement(), cycles=Cycles(cycle_log(cycles))))
    told = [line for line in lines if line.startswith("  all of them are 34 ms into 100 ms: ")]
    assert len(told) == rationed


def test_cycles_that_the_program_makes_late_are_not_the_hosts():
    cycles = records(50)
    late = [3, 13, 23, 33, 43]
    cycles["sent_ns"][late] += 3_000_000
    cycles["cpu_ns"][late] += 3_000_000
    lines = page(replace(measurement(), cycles=Cycles(cycle_log(cycles))))
    assert not [line for line in lines if "rations" in line]


@pytest.mark.parametrize(
    ("field", "cause"),
    [("run_queue_ns", "waiting for the core"), ("cpu_ns", "the program"), (None, "the timer")],
)
def test_cause_of_a_worst_cycle(field: str | None, cause: str):
    sample = measurement()
    cycles = sample.cycles.log.records
    shift = 5_000_000
    if field == "cpu_ns":
        cycles["cpu_ns"][20] += shift
    else:
        cycles["wake_ns"][20] += shift
        if field is not None:
            cycles[field][20] += shift
    for name in ("ticked_ns", "sent_ns"):
        cycles[name][20] += shift
    (worst, *_) = sample.worst()
    assert (worst.slot, worst.cause) == (20, cause)
    assert worst.response == pytest.approx(worst.timer + worst.queued + worst.processor + worst.preempted)


def met(sample: Measurement) -> list[bool | None]:
    return [target.met for target in targets(sample)]


def test_targets():
    good = measurement(2000)
    good.cycles.log.records["ticked_ns"][7] -= 500_000
    good = replace(good, frames=frames_after(good.cycles.log.records, "brake_pressure_cmd", 50))
    assert met(good) == [True, True, True, True]
    good.cycles.log.records["skipped"][100] = 1
    slow_machine = replace(good, machine=Distribution.of_histogram({39.0: 2000}))
    assert met(slow_machine) == [False, False, True, True]


def test_targets_that_cannot_be_told_are_neither_met_nor_missed():
    assert met(replace(measurement(50), machine=None)) == [True, None, True, None]


def test_spacing_and_period_beyond_their_targets():
    sample = measurement(2000)
    cycles = sample.cycles.log.records
    cycles["wake_ns"][::2] += 2_000_000
    cycles["ticked_ns"][::2] += 2_000_000
    late = replace(sample, frames=frames_after(cycles, "brake_pressure_cmd", 50))
    assert met(late)[2:] == [False, False]


def test_whole_loop_joins_sensors_and_command_through_the_estimate():
    """The estimate of slot k goes out 2 ms before the onboard computer's cycle, made from sensors 1.3 ms older."""
    sample = measurement(100)
    autonomy = records(100)
    for name in ("deadline_ns", "wake_ns", "received_ns", "ticked_ns", "sent_ns"):
        autonomy[name] -= 2_120_000
    estimates = frames_after(autonomy, "estimate_position", 30)
    autonomy["newest_ns"][:, Bus.CAN_S] = autonomy["ticked_ns"] - 1_270_000
    cycles = sample.cycles.log.records
    cycles["newest_ns"][:, Bus.CAN_A] = estimates["time_us"] * 1000 + EPOCH_NS + 400_000  # a later frame of that bus
    frames = np.concatenate([sample.frames, estimates])
    whole = replace(
        sample,
        frames=frames[np.argsort(frames["time_us"])],
        stations={"autonomy": Cycles(cycle_log(autonomy, "autonomy", 4713))},
    )
    age = whole.ages["sensors, by the estimate"]
    # Command 230 us after the deadline, the sensor's frame 2120 - 180 + 1270 us before it.
    assert np.delete(age, 7).tolist() == [230.0 + 3210.0] * 99
    assert age[7] == 230.0 + 3210.0 + 1000.0
    assert any(line.startswith("  autonomy: 100 cycles, 0 skipped; us late p50 60.0") for line in page(whole))
    assert "sensors, by the estimate" not in "\n".join(page(sample))


def test_json_holds_everything(tmp_path: Path):
    path = tmp_path / "jitter.json"
    samples = [measurement(2000), replace(measurement(50, "cpu load", 4712), machine=None)]
    write_json(path, as_json({"ecu": "obc"}, look_at_machine(), samples))
    content = json.loads(path.read_text())
    assert content["settings"] == {"ecu": "obc"}
    assert content["machine"]["cores"]
    idle, load = content["runs"]
    assert (idle["condition"], idle["cycles"], idle["skipped"], idle["overruns"]) == ("idle", 2000, 0, 0)
    assert (idle["priority"], idle["cpu"], idle["period_us"]) == (80, 1, 10_000.0)
    lateness = idle["quantities"][0]
    assert [row["label"] for row in lateness["rows"]] == ["raceloop-obc", "waiting for the core", "cyclictest"]
    assert lateness["rows"][0]["p99_9"] == 60.0
    assert sum(lateness["rows"][0]["histogram"]) == 2000
    assert len(lateness["rows"][0]["histogram"]) == len(content["histogram_edges_us"]) - 1
    assert [row["label"] for row in load["quantities"][0]["rows"]] == ["raceloop-obc", "waiting for the core"]
    assert load["quantities"][0]["rows"][0]["p99_9"] is None
    assert idle["worst_cycles"][0]["tasks"] == {"receive": 30, "monitor": 60}
    assert [target["met"] for target in load["targets"]] == [True, None, True, None]
    assert load["notes"] == ["the machine stalled"]


def test_picture_has_a_column_per_condition():
    one = ElementTree.fromstring(picture("OBC", [measurement()]))
    two = ElementTree.fromstring(picture("OBC", [measurement(), measurement(condition="cpu load", process=4712)]))
    assert 2 * float(one.get("width", "0")) == float(two.get("width", "0"))
    texts = " ".join(text.text or "" for text in two.iter("{http://www.w3.org/2000/svg}text"))
    for title in ("Wake-up lateness", "Execution time", "Period, distance from 10 ms", "Spacing error", "Age of input"):
        assert len(re.findall(rf"{title}[^|]*?, (?:idle|cpu load)", texts)) >= 2, title


def test_file_that_cannot_be_written(tmp_path: Path):
    with pytest.raises(RaceloopError, match="cannot be written"):
        write_json(tmp_path / "nowhere" / "jitter.json", {})
    assert list(tmp_path.iterdir()) == []
