"""Ctrl-C and SIGTERM while something must not be torn apart."""

from __future__ import annotations

import signal

import pytest

from tools.stop_signal import asked_to_stop, asked_to_stop_is_ctrl_c, never_interrupted

BOTH = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])


@BOTH
def test_nothing_is_interrupted_however_often_it_is_asked(number: signal.Signals):
    with asked_to_stop_is_ctrl_c():
        before = signal.getsignal(number)
        with never_interrupted() as asked:
            assert not asked()
            signal.raise_signal(number)
            assert asked()
            signal.raise_signal(number)
            assert asked()
        assert signal.getsignal(number) is before
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)


@BOTH
def test_the_handlers_are_back_after_an_error(number: signal.Signals):
    before = signal.getsignal(number)
    with pytest.raises(ZeroDivisionError), never_interrupted():
        raise ZeroDivisionError
    assert signal.getsignal(number) is before


@BOTH
def test_a_second_one_acts_as_ever(number: signal.Signals):
    with asked_to_stop_is_ctrl_c(), asked_to_stop() as asked:
        assert not asked()
        signal.raise_signal(number)
        assert asked()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
