"""During a public function the garbage collector runs rarely; before and after it, the program's thresholds hold."""

import gc
import threading

import pytest

from vijax.runtime.garbage_collection import RELAXED_THRESHOLDS, infrequent_collection
from vijax.runtime.public_api import public_api


@pytest.fixture
def thresholds():
    """Python's default thresholds, as in a program that sets none."""
    before = gc.get_threshold()
    gc.set_threshold(700, 10, 10)
    yield
    gc.set_threshold(*before)


def test_thresholds_are_relaxed_within_a_public_function_only(thresholds):
    assert public_api(gc.get_threshold)() == RELAXED_THRESHOLDS
    assert gc.get_threshold() == (700, 10, 10)


def test_thresholds_are_restored_after_an_error(thresholds):
    with pytest.raises(KeyError), infrequent_collection():
        raise KeyError
    assert gc.get_threshold() == (700, 10, 10)


def test_the_last_thread_that_ends_restores_the_thresholds(thresholds):
    entered, leave = threading.Event(), threading.Event()

    def other():
        with infrequent_collection():
            entered.set()
            leave.wait()

    thread = threading.Thread(target=other)
    with infrequent_collection():
        thread.start()
        entered.wait()
    assert gc.get_threshold() == RELAXED_THRESHOLDS
    leave.set()
    thread.join()
    assert gc.get_threshold() == (700, 10, 10)


@pytest.mark.parametrize("chosen", [(0, 10, 10), (10**6, 5, 5)])
def test_thresholds_that_a_program_has_set_are_respected(thresholds, chosen):
    gc.set_threshold(*chosen)
    with infrequent_collection():
        assert gc.get_threshold() == chosen
