from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from isaacgymenvs_lite.run.stop_request import StopRequest, signals_as_ctrl_c


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_asks_and_the_second_ends(number, caplog):
    with StopRequest() as stop:
        assert stop.requested is False
        os.kill(os.getpid(), number)
        assert stop.requested is True
        assert signal.Signals(number).name in caplog.text
        assert "checkpoint" in caplog.text
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
            # the handler runs before the next instruction at the latest
            signal.sigtimedwait([], 1)


def test_former_handlers_come_back():
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with StopRequest():
        for number, handler in former.items():
            assert signal.getsignal(number) is not handler
    with pytest.raises(ValueError, match="inside"), StopRequest():
        raise ValueError("inside")
    for number, handler in former.items():
        assert signal.getsignal(number) is handler


def test_a_hangup_after_ctrl_c_is_no_second_one():
    with StopRequest():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGHUP)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
            signal.sigtimedwait([], 1)


@pytest.fixture
def under_nohup() -> Iterator[None]:
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    yield
    assert signal.signal(signal.SIGHUP, former) is signal.SIG_IGN


@pytest.mark.usefixtures("under_nohup")
def test_who_ignores_hangups_goes_on_doing_so():
    with StopRequest() as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        assert stop.requested is False
    with signals_as_ctrl_c():
        os.kill(os.getpid(), signal.SIGHUP)
