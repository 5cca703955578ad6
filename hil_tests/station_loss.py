"""What follows when a station of the car is gone: who brakes and why, and that nobody lets go when it is back."""

from __future__ import annotations

import signal
from dataclasses import dataclass

from realtime_rig import FULL_BRAKE_PA, STEERED_BRAKE_PA, Car, Measured

from bridge._native import lib
from dbc.states import SysState
from firmware.tables import own_faults

ECUS = ("obc", "raptor", "space-drive")

FAULTS = {fault.name: fault.id for fault in own_faults()}


@dataclass(frozen=True)
class Loss:
    """What follows from the loss of a part.

    Attributes
    ----------
    gone : the part.
    causes : what stations say about it: message, signal, value.
    brakes : witnesses that brake from their reaction on, whatever comes back.
    returns : witnesses that brake from when the part is back.
    stops : the car comes to a stop without it.
    """

    gone: str
    causes: tuple[tuple[str, str, float], ...]
    brakes: tuple[str, ...]
    returns: tuple[str, ...] = ()
    stops: bool = True


SHUT_DOWN = ("misc_report", "sys_state", SysState.EMERGENCY_SHUTDOWN)
SSM_BRAKES = ("ssm_status", "ssm_state", lib.SSM_FULL_BRAKE)

LOSSES = (
    Loss("obc", (("diagnostic_report", "adlink_hb_lost", 1), SHUT_DOWN), ("raptor",), ("obc",)),
    Loss(
        "raptor",
        (("ssm_status", "ssm_worst_fault", FAULTS["misc_report_missing"]), SSM_BRAKES),
        ("space-drive", "obc"),
        ("raptor",),
    ),
    Loss(
        "space-drive",
        (("diagnostic_report", "est4_sd_comms_loss", 1), SHUT_DOWN, SSM_BRAKES),
        ("raptor", "obc"),
        stops=False,  # nothing else moves the brake
    ),
    Loss(
        "autonomy",
        (("ssm_status", "ssm_worst_fault", FAULTS["estimation_failed"]), SSM_BRAKES),
        ("obc", "raptor"),
    ),
    Loss("plant", (SSM_BRAKES,), ("obc", "raptor"), stops=False),  # the car is in it
)


def lose_and_get_back(it: Car, loss: Loss, number: signal.Signals, allowance_us: int) -> list[Measured]:
    """The others brake in time, and say why; when it is back, started anew or woken up, the car still stands.

    Parameters
    ----------
    it : a car at power-on.
    loss : what is lost.
    number : signal that it gets.
    allowance_us : how late this machine may be beyond a deadline.

    Returns
    -------
    list of Measured
        The reactions.
    """
    it.drive()
    fault_us = it.signal(loss.gone, number)
    measured = it.reacts(loss.gone, fault_us, f"{loss.gone} {number.name}", allowance_us)
    braking_us = it.run.now_us
    it.until(lambda: all(it.says(*cause) for cause in loss.causes), f"{loss.causes}")
    if loss.stops:
        it.until(lambda: it.stands, "standstill")
    comes_back(it, loss.gone, number)
    back_us = it.run.now_us
    it.until(lambda: it.stands, "standstill")
    it.watch(0.5)
    it.still_brakes(braking_us, *loss.brakes)
    it.still_brakes(back_us, *loss.returns)
    demand = it.brake_demand()[1]
    assert min(abs(demand - full) for full in (STEERED_BRAKE_PA, FULL_BRAKE_PA)) < 1e-3 * demand
    assert it.says(*SHUT_DOWN), it.story()
    assert it.stands, it.story()
    return measured


def comes_back(it: Car, part: str, number: signal.Signals) -> None:
    """Wake a part up, or start it anew, and let it work; its buses are up then."""
    if number == signal.SIGSTOP:
        it.signal(part, signal.SIGCONT)
    else:
        assert [str(ended) for ended in it.ended] == [f"{part} was ended by SIGKILL"]
        it.run.restart(part)
        it.until(lambda: it.run.supervisor.is_ready(part), f"{part} to be ready")
    if part == "hub":
        back_us = it.run.now_us
        it.until(lambda: all(it.receiver.braking(ecu)[0][-1] > back_us for ecu in ECUS), "frames of all ECUs")
    else:
        before = it.run.cycles().get(part, 0)
        it.until(lambda: it.run.cycles().get(part, 0) > before + 10, f"cycles of {part}")
