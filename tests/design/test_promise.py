"""What motions promise: which are worth a closer look beside their limits."""

from typing import Any, NamedTuple

import numpy as np

from vijax.design.design_settings import DesignSettings
from vijax.design.promise import Met, at_places, highest_promise, near_limits, promise


class Given(NamedTuple):
    """In place of averages: the objective, and the margins to the limits."""

    objective: np.ndarray
    lacks: np.ndarray

    def value(self, objective: str, device: Any) -> np.ndarray:
        """Give the objective."""
        return self.objective

    def margins(self) -> np.ndarray:
        """Give the margins, [motion, limit]."""
        return self.lacks[:, None]


def met(value, lacks, step, owner):
    zero = np.zeros(len(value), int)
    nothing: Any = None
    given: Any = Given(np.asarray(value, float), np.asarray(lacks, float))
    return Met(
        given, promise(given, nothing, "P"), nothing, nothing, nothing, zero, np.asarray(owner), zero, np.asarray(step)
    )


def test_motion_beside_a_limit_is_near_it_and_so_is_what_lies_one_step_aside():
    # Of the first device the step 3 is 0.2 beyond a limit; of the second all are further, though the first is not.
    every = met(np.ones(7), [-1, -1, -1, -0.2, -1, -1, -0.4], [0, 1, 2, 3, 4, 5, 3], [0, 0, 0, 0, 0, 0, 1])
    near = near_limits(every, every, DesignSettings(max_excess=0.3))
    np.testing.assert_array_equal(near, [False, False, True, True, True, False, False])
    assert near_limits(every, every, DesignSettings(max_excess=0.5))[-1]


def test_the_highest_promise_is_of_what_breaks_no_limit():
    most = highest_promise(3, met([1, 5], [0, -0.1], [0, 1], [0, 0]), met([3], [0], [0], [1]))
    np.testing.assert_allclose(most, [0.0, np.log(3), -np.inf])


def test_a_place_promises_the_mean_of_its_motions_and_their_worst_margin():
    some = met([4, 0, 1, 9], [0.2, 0.1, -0.5, 0.3], [0, 0, 1, 0], [0, 0, 0, 1])._replace(
        z=np.array([[1.0], [1.0], [2.0], [1.0]])
    )
    hope = at_places(some).hope
    np.testing.assert_allclose(np.exp(hope.value), [2, 2, 1, 9])
    np.testing.assert_allclose(hope.lacks, [0, 0, -0.5, 0])
