"""The text of a design report: the lines for one design, and a table of designs along an axis."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from vijax.model.quantities import SIDES
from vijax.model.units import UNITS
from vijax.runtime import validation
from vijax.runtime.doc_pages import see

_PREFIXES = {"G": 1e9, "M": 1e6, "k": 1e3, "": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9, "p": 1e-12, "f": 1e-15}
_TIE = 1e-6  # largest relative difference of the objectives of optima that are called a tie
_MOST_ROWS = 12  # largest number of attractors, motions or optima in a list
_SHORTFALL = 0.02  # the report mentions predictions above this relative excess over the measured objective
_NARROW = 1.0  # change of a quantity [percent] below which the range of a motion is called narrow
_LOSSES = {"lost": "lose the motion", "inadmissible": "are inadmissible"}


def format_amount(value: float, unit: str, digits: int = 7) -> str:
    """Return a value as text with a unit and its prefix, for example 57.75761 uJ."""
    # 0, infinities and NaN have no prefix.
    if not np.isfinite(value) or not value:
        return f"{value:g} {unit}"
    # A value that rounds up to the next factor takes the next prefix.
    size = abs(value) * (1 + 0.5 * 10.0**-digits)
    prefix = next((name for name, factor in _PREFIXES.items() if size >= factor), "f")
    return f"{value / _PREFIXES[prefix]:.{digits}g} {prefix}{unit}"


def format_quantity(name: str, value: float) -> str:
    """Return a tuned quantity as text, for example omega0 = 40.07126 rad/s."""
    return f"{name} = {value:.7g} {UNITS.get(name, '')}".rstrip()


def format_report(report: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of a report, from the result of `describe`."""
    validation.validate_dict("report", report, ("bounds", "objective", "best"), "vijax.design.report.describe")
    ranges = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in report["bounds"].items())
    yield f"tuned: {ranges}; objective {report['objective']}, {report['objective_means']}"
    yield _survey_line(report)
    best = report["best"]
    if best is None:
        yield "no admissible motion was found; motions of the survey:"
        yield from (f"  {advice}" for advice in _advice_lines(report["survey"]))
        yield from _dropped_lines(report)
    else:
        yield from _best_lines(best, report["objective"])
        yield from _dropped_lines(report)
        yield from _range_lines(report["parameter_ranges"], report["arrival"])
        yield from _surroundings_lines(report["surroundings"], best["power"] / best["P"])
        yield from _plane_lines(report["plane"])
        yield from _other_optima_lines(best, report["others"], report["objective"])
        yield from _tolerance_lines(report)
    yield from _unconstrained_lines(report)


def _survey_line(report: dict[str, Any]) -> str:
    """Return the line with the numbers of attractors and ascents."""
    survey = report["survey"]
    others = f", and other motion at {report['places']:,} values" if report["places"] else ""
    return (
        f"survey: {survey['orbits']:,} periodic attractors found from {survey['starts']:,} starts, "
        f"{report['ascents']:,} climbed{others}"
    )


def _dropped_lines(report: dict[str, Any]) -> Iterator[str]:
    """Yield the candidates with a higher predicted objective than the best design."""
    dropped, objective = report["dropped"], report["objective"]
    if not dropped:
        return
    yield f"dropped candidates with a higher prediction: {len(dropped):,}"
    for candidate in dropped[:_MOST_ROWS]:
        tuned = ", ".join(format_quantity(*item) for item in candidate["values"].items())
        measured = (
            f", measured {_format_objective(candidate['measured'], objective)}"
            if np.isfinite(candidate["measured"])
            else ""
        )
        predicted = _format_objective(candidate["predicted"], objective)
        yield f"  {tuned}: {candidate['label']}, predicted {predicted}{measured}: {candidate['reason']}"
    if len(dropped) > _MOST_ROWS:
        yield f"  and {len(dropped) - _MOST_ROWS:,} more"


def _advice_lines(survey: dict[str, Any]) -> Iterator[str]:
    """Yield, for a survey without a design, the motions that it found and a remedy for each."""
    if survey["limit"]:
        yield (
            f"the {survey['limit']} is broken everywhere: the motion with the smallest violation exceeds it by "
            f"{100 * survey['violation']:.3g} %"
        )
    # Number of periodic orbits that break a limit.
    broken = survey["orbits"] - survey["admissible"]
    if broken:
        yield see("model", f"{broken:,} periodic orbits that break a constraint: widen the bounds or the limits")
    if survey["admissible"]:
        yield f"{survey['admissible']:,} admissible orbits without an optimum: raise max_evaluations and starts"
    if survey["aperiodic_points"]:
        where = ", ".join(format_quantity(*item) for item in survey["values"].items())
        harvest = (
            f"P up to {format_amount(survey['P'], 'J', 4)} admissibly, at {where}" if where else "none of it admissible"
        )
        yield (
            f"aperiodic or long motion at {survey['aperiodic_points']:,} of the surveyed values, {harvest}: "
            "move the bounds, or survey more values, from more starts"
        )
    if survey["permanent_contact"]:
        share = 100 * survey["permanent_contact"]
        yield f"{share:.3g} % of the starts in permanent contact with one wall: raise A or lower beta"
    if survey["no_impact"]:
        yield f"{100 * survey['no_impact']:.3g} % of the starts without impacts: narrow the gap"
    if survey["undecided"]:
        yield f"{100 * survey['undecided']:.3g} % of the starts undecided: raise survey_periods"
    if not any(survey[name] for name in ("orbits", "aperiodic_points", "permanent_contact", "no_impact", "undecided")):
        yield "no motion that settles: survey more values, from more starts"


def _best_lines(best: dict[str, Any], objective: str) -> Iterator[str]:
    """Yield the lines of the best design."""
    tuned = ", ".join(format_quantity(name, value) for name, value in best["values"].items())
    pair = best["pair"]
    yield f"best: {tuned}   ({', '.join(f'{name} {value:.6g}' for name, value in pair.items())})"
    # Only a motion that is not an orbit has the field "samples".
    kind, error = best["label"], ""
    if "samples" not in best:
        kind = f"orbit {kind}"
    elif best["P_stderr"]:
        error = f" +- {format_amount(best['P_stderr'], 'J', 2)}"
    yield (
        f"  {kind}: P {format_amount(best['P'], 'J')}{error} per half period, {format_amount(best['power'], 'W')}, "
        f"largest speed into a wall {best['speed']:.6g} m/s"
    )
    if objective in ("mean", "worst"):
        yield f"  objective: {_format_named_objective(best, objective)}"
    # Depths in millimetres.
    deepest = 1e3 * max(best["penetration"])
    yield (
        f"  penetration {deepest:.6g} mm of {_format_limits(best)} allowed; "
        f"harvested at most {100 * max(best['energy_ratio']):.4g} % of the energy that an impact gives, of "
        f"{100 * best['energy_ratio_limit']:.4g} % allowed"
    )
    if "samples" in best:
        yield from _confirmation_lines(best, objective)
    else:
        yield from _orbit_lines(best)
    errors = best.get("gradient_stderr", {})
    gradient = ", ".join(
        f"{name} {slope:.3g}" + (f" +- {errors[name]:.2g}" if name in errors else "")
        for name, slope in best["gradient"].items()
    )
    # An optimum is called interior if it is a certain maximum and no limit or bound is active.
    interior = best["stopped"] == "maximum"
    active = ", ".join(best["active"]) or ("none, an interior optimum" if interior else "none")
    reasons = {
        "noise": "no step gains more than the standard error, which hides a slope",
        "slope": "no ensemble further along the slope was higher",
        "refused": "no ensemble about it was on one motion and as high",
        "outdone": "other candidates have a higher prediction",
        "supremum": "the objective rises up to the end of the orbit: a supremum that no orbit attains",
        "ensembles": "limit reached",
        "evaluations": "limit reached",
        "stalled": "no step is higher though the gradient is not zero: a kink",
    }
    counted = "ensembles" if "samples" in best else "evaluations"
    yield f"  stopped after {best[counted]} {counted}: {reasons.get(best['stopped'], best['stopped'])}"
    yield f"  active constraints: {active}"
    smooth = ", of a smoothed minimum" if objective == "worst" else ""
    yield f"  log-gradient at the end{smooth}: {gradient}"


def _format_limits(best: dict[str, Any]) -> str:
    """Return the penetration limit in millimetres; one limit for each wall if the limits differ."""
    if "penetration_limit" in best:
        return f"{1e3 * best['penetration_limit']:.6g}"
    return " and ".join(f"{1e3 * best[f'penetration_limit_{side}']:.6g} ({side} wall)" for side in SIDES)


def _confirmation_lines(best: dict[str, Any], objective: str) -> Iterator[str]:
    """Yield the results of the confirming simulation of a motion that is not an orbit."""
    exponent = f"; Lyapunov exponent {best['lyapunov']:.3g} a period" if np.isfinite(best["lyapunov"]) else ""
    size = f"{best['samples']} samples simulated for {best['periods']:,} periods each"
    yield f"  {size} at exactly these values{exponent}"
    if best["predicted"] > (1 + _SHORTFALL) * best["objective_value"]:
        predicted, measured = (_format_objective(best[name], objective) for name in ("predicted", "objective_value"))
        yield f"  predicted {predicted} by shorter simulations; the last one measures {measured}"
    if best["kept_limits"] < 1:
        yield f"  {100 * best['kept_limits']:.4g} % of them kept the limits"
    if len(best["shares"]) > 1:
        shares = ", ".join(f"{name} {100 * share:.3g} %" for name, share in list(best["shares"].items())[:_MOST_ROWS])
        yield f"  they ended on: {shares}"


def _orbit_lines(best: dict[str, Any]) -> Iterator[str]:
    """Yield multipliers, condition, residual and clearances of an orbit."""
    modulus = ", ".join(f"{np.hypot(*multiplier):.4g}" for multiplier in best["multipliers"])
    yield f"  |multipliers| {modulus}; condition of I - DP {best['condition']:.4g}; residual {best['residual']:.1e}"
    clearance = best["clearance"]
    yield (
        f"  clear of grazing: slowest impact {clearance['speed']:.4g}, clearance in flight {clearance['flight']:.4g}, "
        f"in contact {clearance['contact']:.4g}, slowest exit over its entry {clearance['exit']:.4g}"
    )


def _range_lines(parameter_ranges: list[dict[str, Any]], arrival: dict[str, Any] | None) -> Iterator[str]:
    """Yield the range with the same motion for each quantity, the motion beyond it, and the arrival of starts."""
    for parameter_range in parameter_ranges:
        for direction in ("below", "above"):
            side = parameter_range[direction]
            if side["persists"]:
                yield f"  {parameter_range['name']} {direction}: the same motion up to {side['percent']:.3g} %"
                continue
            narrow = f", narrower than {_NARROW:g} %" if side["percent"] < _NARROW else ""
            within = "within the limits" if side["admissible"] else "beyond the limits"
            yield (
                f"  {parameter_range['name']} {direction}: persists up to {side['percent']:.3g} %{narrow}; "
                f"then {side['label']}, with P {format_amount(side['P'], 'J', 4)}, {within}"
            )
    if arrival is not None:
        times = ""
        if np.isfinite(arrival["median"]):
            times = f", half of these within {arrival['median']:.0f} periods, 90 % within {arrival['p90']:.0f}"
        yield f"  {100 * arrival['share']:.3g} % of the starts reach it in {arrival['periods']:,} periods{times}"


def _surroundings_lines(nearby: dict[str, Any] | None, rate: float) -> Iterator[str]:
    """Yield the attractors at the best design; `rate` converts joules per half period to watts."""
    if nearby is None:
        return
    if nearby["below"]:
        yield f"  nearest bifurcation along omega0: below, {_edge(nearby['below'])}; above, {_edge(nearby['above'])}"
    yield f"  basin of the motion: {100 * nearby['share']:.4g} % of the starts; all attractors there:"
    listed = nearby["attractors"][:_MOST_ROWS]
    for attractor in listed:
        flaw = "" if attractor["admissible"] else "  inadmissible"
        powers = f"P {format_amount(attractor['P'], 'J', 5)}, {format_amount(attractor['P'] * rate, 'W', 5)}"
        yield f"    {attractor['label']:<18}{100 * attractor['share']:>8.3g} %   {powers}{flaw}"
    if len(nearby["attractors"]) > len(listed):
        yield f"    and {len(nearby['attractors']) - len(listed)} more"


def _plane_lines(plane: dict[str, Any] | None) -> Iterator[str]:
    """Yield the nearest curves in the plane of two tolerances."""
    if plane is None:
        return
    # The distance of a point is the factor on both tolerances that reaches it.
    names, spreads = plane["names"], plane["spreads"]
    axes = " and ".join(f"{name} +-{100 * spread:.3g} %" for name, spread in zip(names, spreads, strict=True))
    yield f"  in the plane of {axes}, {plane['curves']} curves of bifurcations and limits:"
    for kind, point in (("bifurcation", plane["nearest"]), ("limit", plane["limit"])):
        if point is None:
            reach = ", ".join(f"{name} {low:.5g} to {high:.5g}" for name, (low, high) in plane["bounds"].items())
            yield f"    nearest {kind}: none within {reach}"
            continue
        where = ", ".join(f"{name} {off:+.3g} %" for name, off in zip(names, point["percent"], strict=True))
        yield f"    nearest {kind}: {point['kind']}, {point['factor']:.3g} times the tolerances away, at {where}"


def _edge(edge: dict[str, Any]) -> str:
    """Return a bifurcation as text."""
    if edge["kind"] == "none":
        return f"none within {abs(edge['percent']):.3g} %"
    return f"{edge['kind']} {abs(edge['percent']):.3g} % off at {edge['omega0']:.6g} rad/s"


def _format_named_objective(optimum: dict[str, Any], objective: str) -> str:
    """Return name and value of the objective of an optimum as text, for example worst 51.78932 uJ."""
    return f"{objective} {_format_objective(optimum['objective_value'], objective, 7)}"


def _format_objective(value: float, objective: str, digits: int = 4) -> str:
    """Return a value of an objective as text, for example 51.78932 uJ."""
    return format_amount(value, {"power": "W", "speed": "m/s"}.get(objective, "J"), digits)


def _other_optima_lines(best: dict[str, Any], others: list[dict[str, Any]], objective: str) -> Iterator[str]:
    """Yield the other local optima."""
    yield f"other local optima: {len(others) or 'none'}"
    for optimum in others[:_MOST_ROWS]:
        tuned = ", ".join(format_quantity(name, value) for name, value in optimum["values"].items())
        tie = "  an exact tie" if abs(optimum["objective_value"] / best["objective_value"] - 1) < _TIE else ""
        value = _format_named_objective(optimum, objective)
        yield f"  {tuned}: {optimum['label']}, {value}, {_format_active(optimum)}{tie}"


def _tolerance_lines(report: dict[str, Any]) -> Iterator[str]:
    """Yield the statistics over tolerances."""
    spread = report["spread"]
    if spread is None:
        return
    tolerances = ", ".join(
        f"{tolerance['name']} +-{100 * tolerance['spread']:g} % {tolerance['kind']}"
        for tolerance in report["tolerances"]
    )
    yield f"under tolerances ({tolerances}):"
    # Power is P omega/pi. All devices have the omega of the best design, so power / P is the same.
    nominal = report["best"]["P"]
    counted = _counting_notes(spread)
    for name in ("mean", "worst"):
        power = spread[name] * report["best"]["power"] / nominal
        powers = f"{format_amount(spread[name], 'J')}, {format_amount(power, 'W')}"
        yield f"  {name} P {powers}, {100 * spread[name] / nominal:.4g} % of nominal{counted[name]}"
    shares = ", ".join(f"{100 * spread[name]:.3g} % {text}" for name, text in _LOSSES.items())
    yield f"  of the devices, {shares}"
    # The ranking includes any motion of the devices; the statistics above include only the motion of the design.
    yield from _ranking_lines(report)


def _counting_notes(spread: dict[str, Any]) -> dict[str, str]:
    """Return notes, by statistic, on the P assigned to devices that lose the motion or are inadmissible.

    Inadmissible devices count as 0 in the mean but with their P in the worst value, so the worst P may exceed the mean.
    """
    # A loss without devices is not mentioned.
    lost = " or ".join(text for name, text in _LOSSES.items() if spread[name])
    return {
        "mean": f", those that {lost} counting as 0" if lost else "",
        "worst": ", inadmissible ones counting with their P" if spread["inadmissible"] else "",
    }


def _ranking_lines(report: dict[str, Any]) -> Iterator[str]:
    """If another optimum than the best has the highest mean P over the tolerances, yield a line about it."""
    # `optimum` is the index of an optimum in the design; 0 is the best optimum, and `others` begins at 1.
    first = next(iter(report["ranking"]), None)
    if first is None or not first["optimum"]:
        return
    optimum = report["others"][first["optimum"] - 1]
    tuned = ", ".join(format_quantity(name, value) for name, value in optimum["values"].items())
    best_row = next(row for row in report["ranking"] if not row["optimum"])
    yield (
        f"  another optimum has a higher mean there: {tuned}, {optimum['label']}, "
        f"mean P {format_amount(first['mean'], 'J', 5)} "
        f"against {format_amount(best_row['mean'], 'J', 5)} for the best design, with any motion"
    )


def _unconstrained_lines(report: dict[str, Any]) -> Iterator[str]:
    """Yield the point of the diagram with the largest P, if it is inadmissible and exceeds the P of the best design."""
    peak, best = report["highest"], report["best"]
    if peak is None or peak["admissible"] or (best is not None and peak["P"] <= best["P"]):
        return
    # Without a best design no ratio is printed.
    more = f"{peak['P'] / best['P']:.4g} times as much, " if best else ""
    limits = "not physical" if peak["unphysical"] else "inadmissible"
    yield (
        f"{limits}: the largest P without limits is at {format_quantity(peak['along'], peak['value'])} "
        f"with {format_amount(peak['P'], 'J')}, "
        f"{more}{1e3 * peak['max_penetration']:.4g} mm deep, "
        f"{peak['energy_ratio']:.4g} times the energy that an impact gives"
    )


def format_table(report: dict[str, Any]) -> Iterator[str]:
    """Yield the best designs along an axis, one line each.

    Args:
        report: `over` has the name and values of the axis, `designs` the result of `describe` at each value.
    """
    validation.validate_dict("report", report, ("over", "designs"), "scripts/design.py --over")
    name, values = report["over"]["name"], report["over"]["values"]
    for value, design in zip(values, report["designs"], strict=True):
        best = design["best"]
        if best is None:
            yield f"{name} {value:.5g}: no admissible motion; {next(_advice_lines(design['survey']))}"
            continue
        tuned = ", ".join(format_quantity(*item) for item in best["values"].items())
        spread = f", at worst {format_amount(design['spread']['worst'], 'J', 5)}" if design["spread"] else ""
        powers = f"P {format_amount(best['P'], 'J', 5)}, {format_amount(best['power'], 'W', 5)}"
        yield f"{name} {value:.5g}: {tuned}, {best['label']}, {powers}{spread}, {_format_active(best)}"


def _format_active(best: dict[str, Any]) -> str:
    """Return the active limits and bounds of a design as text; if there are none, the reason why its search ended."""
    return ", ".join(best["active"]) or ("interior" if best["stopped"] == "maximum" else best["stopped"])
