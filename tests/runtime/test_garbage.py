"""While a public function runs the collector of garbage looks seldom; before and after as the program has it."""

import gc
import threading

import pytest

from vijax.runtime.context import door
from vijax.runtime.garbage import SELDOM, seldom_collected


@pytest.fixture
def thresholds():
    """Python's own, as a program has them that sets none."""
    before = gc.get_threshold()
    gc.set_threshold(700, 10, 10)
    yield
    gc.set_threshold(*before)


def test_within_a_public_function_and_not_after_it(thresholds):
    assert door(gc.get_threshold)() == SELDOM
    assert gc.get_threshold() == (700, 10, 10)


def test_after_an_error_too(thresholds):
    with pytest.raises(KeyError), seldom_collected():
        raise KeyError
    assert gc.get_threshold() == (700, 10, 10)


def test_the_last_thread_that_leaves_sets_it_back(thresholds):
    entered, leave = threading.Event(), threading.Event()

    def other():
        with seldom_collected():
            entered.set()
            leave.wait()

    thread = threading.Thread(target=other)
    with seldom_collected():
        thread.start()
        entered.wait()
    assert gc.get_threshold() == SELDOM
    leave.set()
    thread.join()
    assert gc.get_threshold() == (700, 10, 10)


@pytest.mark.parametrize("own", [(0, 10, 10), (10**6, 5, 5)])
def test_what_a_program_has_chosen_stands(thresholds, own):
    gc.set_threshold(*own)
    with seldom_collected():
        assert gc.get_threshold() == own
