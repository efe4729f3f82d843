"""The model that is fitted to a series of impacts."""

from dataclasses import dataclass

import numpy as np

from vijax.fitting.fit_excitation import FitExcitation
from vijax.model.choices import Walls
from vijax.model.device import Harvester


@dataclass(frozen=True)
class FitModel:
    """A device with unknown constants, and its excitation.

    Attributes:
        device: Specifies all known constants.
        names: Names of the unknowns, in the order of the variables.
        wall: Kind of the walls.
        excitation: Forcing of the capsule, in the form of a fit.
        limits: Least and largest value of the variable of each unknown [2, unknown]. A variable is the coordinate in
            which an unknown is searched, for most unknowns the logarithm of its value (see `unknowns`).
    """

    device: Harvester
    names: tuple[str, ...]
    wall: Walls
    excitation: FitExcitation
    limits: np.ndarray
