"""What is fitted to a series of impacts."""

from dataclasses import dataclass

import numpy as np

from vijax.fitting.shaking import Shaking
from vijax.model.choices import Walls
from vijax.model.device import Harvester


@dataclass(frozen=True)
class FitModel:
    """A device of which some is unknown.

    Attributes:
        device: Gives all that is known.
        names: The unknowns, see `unknowns`.
        wall: What the walls are.
        shaking: The excitation.
        limits: Least and largest variables of the unknowns [2, unknown].
    """

    device: Harvester
    names: tuple[str, ...]
    wall: Walls
    shaking: Shaking
    limits: np.ndarray
