"""Space Drive: frames on CAN3, their rates, counters, CRCs and contents."""

from __future__ import annotations

from collections import Counter

import pytest
from actuator_ecus import BRAKE_STOP, DEG, Outbox, Requests, SpaceDrive

from bridge._native import ffi, lib
from dbc.codec import database
from dbc.frames import Bus, Station
from dbc.network import own_network


def sent_over(seconds: float, drive: SpaceDrive | None = None) -> list[list[object]]:
    drive, requests = drive or SpaceDrive(), Requests(0.1, 1.0e6, 30)
    return [drive.tick(requests.frames()).frames for _ in range(round(seconds * 100))]


def test_every_message_leaves_at_its_cycle_time() -> None:
    counts: Counter[int] = Counter(frame.id for frames in sent_over(1.0) for frame in frames)  # type: ignore[attr-defined]
    expected = {
        message.frame_id: 1_000_000 // message.cycle_us
        for message in database
        if message.bus == Bus.CAN3 and message.sender == Station.SPACE_DRIVE
    }
    assert len(expected) == 18
    assert counts == expected


def test_the_load_is_spread_over_the_ticks() -> None:
    per_tick = [len(frames) for frames in sent_over(1.0)]
    assert max(per_tick) <= 12
    assert min(per_tick) >= 9


def test_positions_carry_moving_counters_and_valid_crcs() -> None:
    receivers = {identifier: ffi.new("codec_rx *") for identifier in range(0x120, 0x126)}
    counters: dict[int, list[int]] = {identifier: [] for identifier in receivers}
    for tick, frames in enumerate(sent_over(3.0)):
        for frame in frames:
            if frame.id in receivers:  # type: ignore[attr-defined]
                pointer = ffi.new("can_frame *")
                ffi.buffer(pointer)[:] = frame.pack()  # type: ignore[attr-defined]
                assert lib.codec_receive(receivers[frame.id], pointer, tick) == 0  # type: ignore[attr-defined]
                counters[frame.id].append(frame.data[5])  # type: ignore[attr-defined]
    for values in counters.values():
        assert values == [number % 256 for number in range(300)]


FAMILIES = {
    "calb": [f"calb_{axis}_pos_{n}" for axis in ("steer", "brake") for n in (1, 2, 3)],
    "act_err": [f"act_err_{axis}_{n}" for axis in ("steer", "brake") for n in (1, 2, 3)],
    "stat_steer": [f"stat_steer_{n}" for n in (1, 2, 3)],
    "stat_brk": [f"stat_brk_{n}" for n in (1, 2, 3)],
}


@pytest.mark.parametrize("family", FAMILIES)
def test_messages_of_a_family_share_one_layout(family: str) -> None:
    """The firmware packs each family with one function."""
    messages = {facts.message.name: facts.message for facts in own_network()}
    layouts = {
        tuple((s.start, s.length, s.byte_order, s.is_signed, s.scale, s.offset) for s in messages[name].signals)
        for name in FAMILIES[family]
    }
    assert len(layouts) == 1


def test_emr_brk_has_one_place_in_both_status_families() -> None:
    messages = {facts.message.name: facts.message for facts in own_network()}
    places = {messages[n].get_signal_by_name("emr_brk").start for f in ("stat_steer", "stat_brk") for n in FAMILIES[f]}
    assert len(places) == 1


def test_positions_show_the_sensors() -> None:
    drive, requests = SpaceDrive(), Requests()
    drive.follow = False
    for channel, angle in enumerate((-2.0, 1.0, 2.0)):
        drive.wired.steer_motor_angle[channel] = angle * DEG
        drive.wired.brake_pressure[channel] = 1.0e6 + 1.0e5 * channel
    sent = drive.tick(requests.frames())
    for channel, angle in enumerate((-2.0, 1.0, 2.0)):
        steer = sent.value(f"calb_steer_pos_{channel + 1}", f"cur_steer_pos_steering_pos_{channel + 1}")
        assert steer == round(0x4000 * (1 + angle / 240))
        brake = sent.value(f"calb_brake_pos_{channel + 1}", f"cur_brake_pos_brake_pos_{channel + 1}")
        assert brake == round(0x4000 * (1 - (1.0e6 + 1.0e5 * channel) / BRAKE_STOP))


def newest(drive: SpaceDrive, requests: Requests, name: str, ticks: int = 12) -> dict[str, float]:
    rows: list[dict[str, float]] = []
    for _ in range(ticks):
        rows += drive.tick(requests.frames()).of(name)
    return rows[-1]


def test_status_while_all_is_well() -> None:
    drive, requests = SpaceDrive(), Requests(0.0, 1.0e6, 30)
    steer, brake = newest(drive, requests, "stat_steer_2"), newest(drive, requests, "stat_brk_3")
    assert {name for name, value in steer.items() if value} == {
        "Ign_actv", "ip_sgnl_vald", "str_ctrl_act", "brk_lit_actv", "veh_in_motn",
    }  # fmt: skip
    assert (brake["main_batt_curr_volt_val"], brake["bkp_batt_curr_vol_val"]) == (13_200, 12_800)
    assert brake["curr_ip_dvc_pos"] == round(0x4000 * (1 - 1 / 6))
    assert (brake["emr_brk"], brake["brk_crtlr_actv"], brake["ip_sgnl_vald"], brake["strt_initial"]) == (0, 1, 1, 0)


def test_status_tells_of_the_emergency_brake_on_every_channel() -> None:
    drive, requests = SpaceDrive(), Requests()
    for _ in range(5):
        drive.tick(requests.frames())
    sent = [drive.tick() for _ in range(20)]
    for name in [*FAMILIES["stat_steer"], *FAMILIES["stat_brk"]]:
        row = next(m.of(name)[-1] for m in reversed(sent) if m.of(name))
        assert (row["emr_brk"], row["warn_ton_actv"], row["ip_sgnl_vald"]) == (1, 1, 0)
    for name in FAMILIES["act_err"]:
        row = next(m.of(name)[-1] for m in reversed(sent) if m.of(name))
        assert {signal for signal, value in row.items() if value} == {"err_CAN_1", "crtcl_err_recognzd"}


@pytest.mark.parametrize(
    ("main", "backup", "errors"),
    [
        (13.0, 13.0, set()),
        (9.9, 13.0, {"Vol_main_batt_lo"}),
        (16.1, 13.0, {"Vol_main_batt_hi"}),
        (13.0, 0.0, {"Vol_bkp_batt_lo"}),
        (13.0, 17.0, {"Vol_bkp_batt_hi"}),
        (float("nan"), float("inf"), {"Vol_main_batt_lo", "Vol_bkp_batt_hi"}),
    ],
)
def test_battery_errors(main: float, backup: float, errors: set[str]) -> None:
    drive, requests = SpaceDrive(), Requests()
    drive.wired.main_battery, drive.wired.backup_battery = main, backup
    for name in ("act_err_steer_1", "act_err_brake_3"):
        assert {signal for signal, value in newest(drive, requests, name).items() if value} == errors
    assert drive.c.emergency == 0


@pytest.mark.parametrize(("volts", "raw"), [(float("nan"), 0), (-1.0, 0), (70.0, 65_535), (float("inf"), 65_535)])
def test_voltages_saturate(volts: float, raw: int) -> None:
    drive, requests = SpaceDrive(), Requests()
    drive.wired.main_battery = volts
    assert newest(drive, requests, "stat_brk_1")["main_batt_curr_volt_val"] == raw


def test_a_full_outbox_loses_frames_and_nothing_else() -> None:
    drive, requests = SpaceDrive(), Requests(0.1, 1.0e6)
    for capacity in (0, 1, 7, 9, 11):
        drive.outbox = Outbox(capacity)
        for _ in range(20):
            assert len(drive.tick(requests.frames()).frames) <= capacity
        assert drive.outbox.c.dropped > 0
    assert drive.drive.brake_pressure_demand == pytest.approx(1.0e6, abs=200)
