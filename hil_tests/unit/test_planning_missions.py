"""Which mission follows from the SSM's state, the car's state and race control's flags: the whole table."""

import itertools

import pytest

from autonomy.planning import choose_mission
from autonomy.status import Mission, SsmStatus, VehicleStatus
from dbc.states import SsmState

CT_STATES = [*range(13), 255]
FLAGS = range(16)


def mission(ssm, ct, flag=0, on_race_line=True):
    return choose_mission(SsmStatus(ssm, 60.0, 5.0, 8.0), VehicleStatus(ct, flag, 13.9), on_race_line)


@pytest.mark.parametrize(
    ("ct", "flag", "on_race_line", "expected"),
    [
        (7, 0, False, Mission.PIT_OUT),
        (7, 0, True, Mission.CAUTION),
        (8, 0, False, Mission.PIT_OUT),
        (8, 0, True, Mission.CAUTION),
        (8, 4, True, Mission.STOP),
        (9, 0, True, Mission.RACE),
        (9, 0, False, Mission.RACE),
        (9, 4, True, Mission.STOP),
        (10, 0, True, Mission.STOP),
        (11, 4, True, Mission.HOLD),
        (12, 8, True, Mission.HOLD),
    ],
)
@pytest.mark.parametrize("ssm", [SsmState.NOMINAL, SsmState.DEGRADED])
def test_missions_while_driving_is_allowed(ssm, ct, flag, on_race_line, expected):
    assert mission(ssm, ct, flag, on_race_line) is expected


def test_nothing_but_nominal_and_degraded_lets_the_car_drive():
    for ssm, ct, flag, line in itertools.product(range(16), CT_STATES, FLAGS, (False, True)):
        got = mission(ssm, ct, flag, line)
        if ssm == SsmState.EMERGENCY:
            assert got is Mission.STOP
        elif ssm not in (SsmState.NOMINAL, SsmState.DEGRADED):
            assert got is Mission.HOLD


def test_no_other_state_of_the_car_lets_it_drive():
    for ct, flag in itertools.product(CT_STATES, FLAGS):
        if ct not in (7, 8, 9):
            assert mission(SsmState.NOMINAL, ct, flag) in (Mission.HOLD, Mission.STOP)


def test_only_nominal_race_is_raced():
    for ct, flag in itertools.product(CT_STATES, FLAGS):
        assert (mission(SsmState.NOMINAL, ct, flag) is Mission.RACE) == (ct == 9 and flag != 4)
