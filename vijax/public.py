"""Public names of vijax and their modules: `vijax.__init__` parses these lines, and imports a name at first use."""

from typing import TYPE_CHECKING

from vijax.continuation.branch_continuation import Branch, follow_orbits
from vijax.continuation.branch_dataset import branch_dataset
from vijax.continuation.branch_switching import follow_families
from vijax.continuation.continuation_settings import ContinuationSettings
from vijax.continuation.curves.curve_dataset import curve_dataset
from vijax.continuation.curves.curve_table import curve_rows
from vijax.continuation.curves.curves import BifurcationCurve, follow_curves
from vijax.continuation.curves.orbit_curves import curves_about
from vijax.continuation.from_map.map_curves import MapCurves, bifurcation_curves
from vijax.continuation.limits import limit_points
from vijax.design.aperiodic.average import Average, Smoothness, average
from vijax.design.design_settings import DesignSettings
from vijax.design.optimise import Design, optimise, tolerance_statistics
from vijax.design.optimum import AperiodicOptimum, Optimum
from vijax.design.robustness.off_design import arrival_statistics, parameter_ranges
from vijax.design.robustness.surroundings import Surroundings, maximise_basin_power, surroundings
from vijax.design.robustness.tolerance import Tolerance
from vijax.design.robustness.tolerance_plane import TolerancePlane, tolerance_plane
from vijax.explorer.explore import explore
from vijax.fitting.fit import fit
from vijax.fitting.fit_result import ConstancyTest, Fit, Misfit
from vijax.maps.basins import basin_fractions, basins
from vijax.maps.chaos import lyapunov, survival
from vijax.maps.compare import cheapest_model, compare, rigid_from
from vijax.maps.orbit_diagram import orbit_diagram
from vijax.maps.response import response
from vijax.maps.storage.store import load, save
from vijax.maps.sweep import sweep
from vijax.model.device import Harvester
from vijax.model.energy import harvested_energy
from vijax.model.forcing.excitation import Excitation, Harmonics, Noise, Record, Waveform
from vijax.model.pair import ImpactPair, impact_pair
from vijax.model.records import Impact, State, Status
from vijax.model.walls.laws import HuntCrossley, Hyperelastic
from vijax.model.walls.membrane import MembraneLaw
from vijax.model.walls.sides import Sides
from vijax.orbits.orbit_properties import orbit_impacts, orbit_labels, orbit_path, orbit_power
from vijax.orbits.orbit_search import find_orbits, orbits_from_states
from vijax.orbits.periodic import Orbit
from vijax.orbits.steady import Steady, steady
from vijax.simulation.run_records import Trajectory
from vijax.simulation.trajectory import trajectory

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
    "arrival_statistics",
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
    "maximise_basin_power",
    "optimise",
    "orbit_diagram",
    "orbit_impacts",
    "orbit_labels",
    "orbit_path",
    "orbit_power",
    "orbits_from_states",
    "parameter_ranges",
    "plots",
    "response",
    "rigid_from",
    "save",
    "steady",
    "surroundings",
    "survival",
    "sweep",
    "tolerance_plane",
    "tolerance_statistics",
    "trajectory",
]
