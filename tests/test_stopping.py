from __future__ import annotations

import os
import signal
import threading

import pytest

from isaacgymenvs_lite.stopping import StopRequest


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


def test_one_signal_after_the_other_counts_as_two():
    with StopRequest():
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
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


def test_beside_the_main_thread_nothing_is_caught():
    """Python takes signals in the main thread only; a run in a worker must work without."""
    errors: list[BaseException] = []

    def work() -> None:
        try:
            with StopRequest() as stop:
                assert stop.requested is False
        except BaseException as error:
            errors.append(error)

    former = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert errors == []
    assert signal.getsignal(signal.SIGINT) is former
