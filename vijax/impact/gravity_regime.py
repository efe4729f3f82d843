"""Regime of gravity of the cells of a program: a static choice that removes unneeded parts from the fast step."""

import enum
from typing import Any

import numpy as np

# From this |gamma| on, the fast step also certifies contacts that gravity prolongs. They are 1 to 2 % of all contacts,
# and their code makes each impact a sixth slower. The choice changes results only in their last digits.
_STRONG = 0.2


class GravityRegime(enum.Enum):
    """Regime of the largest |gamma| of all cells of a program.

    NONE: gamma is 0 in all cells. WEAK: the largest |gamma| is below `_STRONG`. STRONG: it is `_STRONG` or more.
    """

    NONE = "none"  # gamma is 0
    WEAK = "weak"
    STRONG = "strong"


def gravity_regime_of(gamma: Any) -> GravityRegime:
    """Return the gravity regime of cells with these values of gamma."""
    most = np.max(np.abs(np.asarray(gamma)), initial=0.0)
    if most == 0:
        return GravityRegime.NONE
    return GravityRegime.STRONG if most >= _STRONG else GravityRegime.WEAK
