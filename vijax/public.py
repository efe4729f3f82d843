"""What `import vijax` offers, and where: `vijax.__init__` reads these lines, and loads a name as it is asked for."""

from typing import TYPE_CHECKING

from vijax.batch.run_records import Trajectory
from vijax.batch.trajectory import trajectory
from vijax.design.average import Average, Smoothness, average
from vijax.design.design_settings import DesignSettings
from vijax.design.off_design import arrival as design_arrival
from vijax.design.off_design import extents as design_extents
from vijax.design.optimise import Design, optimise
from vijax.design.optimise import under as under_tolerances
from vijax.design.optimum import AperiodicOptimum, Optimum
from vijax.design.robustness import Surroundings, surroundings
from vijax.design.robustness import weighted as weigh_basins
from vijax.design.tolerance import Tolerance
from vijax.design.tolerance_plane import TolerancePlane
from vijax.design.tolerance_plane import tolerance_plane as design_plane
from vijax.explorer.door import explore
from vijax.fitting.fit import fit
from vijax.fitting.fitted import ConstancyTest, Fit, Misfit
from vijax.model.device import Harvester
from vijax.model.energy import harvested_energy
from vijax.model.excitation import Excitation, Harmonics, Noise, Record, Waveform
from vijax.model.laws import HuntCrossley, Hyperelastic
from vijax.model.membrane import MembraneLaw
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Impact, State, Status
from vijax.model.sides import Sides
from vijax.orbits.branch_dataset import dataset as branch_dataset
from vijax.orbits.continuation import Branch
from vijax.orbits.continuation import follow as follow_orbits
from vijax.orbits.continuation_settings import ContinuationSettings
from vijax.orbits.curve_dataset import curve_dataset
from vijax.orbits.curve_rows import curve_rows
from vijax.orbits.curves import BifurcationCurve, follow_curves
from vijax.orbits.limits import limit_points
from vijax.orbits.map_curves import MapCurves, bifurcation_curves
from vijax.orbits.orbit_curves import curves_about
from vijax.orbits.orbit_properties import impacts as orbit_impacts
from vijax.orbits.orbit_properties import labels as orbit_labels
from vijax.orbits.orbit_properties import path as orbit_path
from vijax.orbits.orbit_properties import power as orbit_power
from vijax.orbits.orbit_search import from_state as orbits_from_states
from vijax.orbits.orbit_search import search as find_orbits
from vijax.orbits.periodic import Orbit
from vijax.orbits.steady import Steady, steady
from vijax.orbits.switching import family as follow_families
from vijax.planes.basins import basin_fractions, basins
from vijax.planes.chaos import lyapunov, survival
from vijax.planes.compare import cheapest_model, compare, rigid_from
from vijax.planes.orbit_diagram import orbit_diagram
from vijax.planes.response import response
from vijax.planes.store import load, save
from vijax.planes.sweep import sweep

if TYPE_CHECKING:
    import vijax.plots as plots

__all__ = [
    "AperiodicOptimum",
    "Average",
    "BifurcationCurve",
    "Branch",
    "ConstancyTest",
    "ContinuationSettings",
    "Design",
    "DesignSettings",
    "Excitation",
    "Fit",
    "Harmonics",
    "Harvester",
    "HuntCrossley",
    "Hyperelastic",
    "Impact",
    "ImpactPair",
    "MapCurves",
    "MembraneLaw",
    "Misfit",
    "Noise",
    "Optimum",
    "Orbit",
    "Record",
    "Sides",
    "Smoothness",
    "State",
    "Status",
    "Steady",
    "Surroundings",
    "Tolerance",
    "TolerancePlane",
    "Trajectory",
    "Waveform",
    "average",
    "basin_fractions",
    "basins",
    "bifurcation_curves",
    "branch_dataset",
    "cheapest_model",
    "compare",
    "curve_dataset",
    "curve_rows",
    "curves_about",
    "design_arrival",
    "design_extents",
    "design_plane",
    "explore",
    "find_orbits",
    "fit",
    "follow_curves",
    "follow_families",
    "follow_orbits",
    "harvested_energy",
    "impact_pair",
    "limit_points",
    "load",
    "lyapunov",
    "optimise",
    "orbit_diagram",
    "orbit_impacts",
    "orbit_labels",
    "orbit_path",
    "orbit_power",
    "orbits_from_states",
    "plots",
    "response",
    "rigid_from",
    "save",
    "steady",
    "surroundings",
    "survival",
    "sweep",
    "trajectory",
    "under_tolerances",
    "weigh_basins",
]
