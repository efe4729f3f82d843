"""What a builder reads of a design: the lines of a report, and a table of the reports along an axis."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from vijax.model.units import UNITS
from vijax.runtime import checks
from vijax.runtime.pages import see

_PREFIXES = {"G": 1e9, "M": 1e6, "k": 1e3, "": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9, "p": 1e-12, "f": 1e-15}
_TIE = 1e-6  # optima whose objectives differ by less, relative, are a tie
_MOST_ROWS = 12  # attractors, motions or optima that a report lists
_LESS = 0.02  # part of the objective: a flight that measures so much less than was predicted says so
_NARROW = 1.0  # percent: a motion that lasts for less of a quantity than this is called narrow
_LOSSES = {"lost": "lose the motion", "inadmissible": "are inadmissible"}


def amount(value: float, unit: str, digits: int = 7) -> str:
    """Write a value with a prefix of its unit: 57.75761 uJ."""
    if not np.isfinite(value) or not value:
        return f"{value:g} {unit}"
    size = abs(value) * (1 + 0.5 * 10.0**-digits)
    prefix = next((name for name, factor in _PREFIXES.items() if size >= factor), "f")
    return f"{value / _PREFIXES[prefix]:.{digits}g} {prefix}{unit}"


def quantity(name: str, value: float) -> str:
    """Write a tuned quantity: omega0 = 40.07126 rad/s."""
    return f"{name} = {value:.7g} {UNITS.get(name, '')}".rstrip()


def lines(report: dict[str, Any]) -> Iterator[str]:
    """Say what a builder needs to know before trusting a design, from what `describe` returned."""
    checks.record("report", report, ("bounds", "objective", "best"), "vijax.design.report.describe")
    ranges = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in report["bounds"].items())
    yield f"tuned: {ranges}; objective {report['objective']}, {report['objective_means']}"
    yield _candidates(report)
    best = report["best"]
    if best is None:
        yield "no admissible motion was found; what the survey met instead:"
        yield from (f"  {what}" for what in _instead(report["survey"]))
        yield from _dropped(report)
    else:
        yield from _best(best, report["objective"])
        yield from _dropped(report)
        yield from _off_design(report["extents"], report["arrival"])
        yield from _around(report["surroundings"], best["power"] / best["P"])
        yield from _in_plane(report["plane"])
        yield from _others(best, report["others"], report["objective"])
        yield from _off(report)
    yield from _unconstrained(report)


def _candidates(report: dict[str, Any]) -> str:
    """Count what the survey met and the candidates for the best design."""
    survey = report["survey"]
    others = f", and other motion at {report['places']:,} values" if report["places"] else ""
    return (
        f"survey: {survey['orbits']:,} periodic attractors met by {survey['starts']:,} starts, "
        f"{report['ascents']:,} climbed{others}"
    )


def _dropped(report: dict[str, Any]) -> Iterator[str]:
    """List the candidates that promised more than the best design gives."""
    dropped, objective = report["dropped"], report["objective"]
    if not dropped:
        return
    yield f"dropped, though more was predicted: {len(dropped):,}"
    for one in dropped[:_MOST_ROWS]:
        tuned = ", ".join(quantity(*item) for item in one["values"].items())
        measured = f", measured {_objective(one['measured'], objective)}" if np.isfinite(one["measured"]) else ""
        predicted = _objective(one["predicted"], objective)
        yield f"  {tuned}: {one['label']}, predicted {predicted}{measured}: {one['reason']}"
    if len(dropped) > _MOST_ROWS:
        yield f"  and {len(dropped) - _MOST_ROWS:,} more"


def _instead(survey: dict[str, Any]) -> Iterator[str]:
    """Say what a survey met where no design came of it, and what to do about each."""
    if survey["limit"]:
        yield (
            f"the {survey['limit']} stands everywhere: the motion nearest to keeping the limits exceeds it by "
            f"{100 * survey['excess']:.3g} %"
        )
    broken = survey["orbits"] - survey["admissible"]
    if broken:
        yield see("model", f"{broken:,} periodic orbits that break a constraint: widen the bounds or the limits")
    if survey["admissible"]:
        yield f"{survey['admissible']:,} admissible orbits that led to no optimum: take more steps and balls"
    if survey["restless"]:
        where = ", ".join(quantity(*item) for item in survey["values"].items())
        harvest = f"P up to {amount(survey['P'], 'J', 4)} admissibly, at {where}" if where else "none of it admissible"
        yield (
            f"aperiodic or long motion at {survey['restless']:,} of the values looked at, {harvest}: move the bounds, "
            "or look at more values, from more starts"
        )
    if survey["held"]:
        yield f"{100 * survey['held']:.3g} % of the starts on one wall for ever: raise A or lower beta"
    if survey["silent"]:
        yield f"{100 * survey['silent']:.3g} % of the starts without impacts: narrow the gap"
    if survey["slow"]:
        yield f"{100 * survey['slow']:.3g} % of the starts undecided: raise survey_periods"
    if not any(survey[name] for name in ("orbits", "restless", "held", "silent", "slow")):
        yield "nothing that settles: look at more values, from more starts"


def _best(best: dict[str, Any], objective: str) -> Iterator[str]:
    tuned = ", ".join(quantity(name, value) for name, value in best["values"].items())
    pair = best["pair"]
    yield f"best: {tuned}   ({', '.join(f'{name} {value:.6g}' for name, value in pair.items())})"
    kind, error = best["label"], ""
    if "balls" not in best:
        kind = f"orbit {kind}"
    elif best["P_stderr"]:
        error = f" +- {amount(best['P_stderr'], 'J', 2)}"
    yield (
        f"  {kind}: P {amount(best['P'], 'J')}{error} per half period, {amount(best['power'], 'W')}, "
        f"largest speed into a wall {best['speed']:.6g} m/s"
    )
    if objective in ("mean", "worst"):
        yield f"  objective: {_height(best, objective)}"
    deepest, limit = 1e3 * max(best["penetration"]), 1e3 * best["penetration_limit"]
    yield (
        f"  penetration {deepest:.6g} mm of {limit:.6g} allowed; "
        f"harvested at most {100 * max(best['energy_ratio']):.4g} % of the energy that an impact gives, of "
        f"{100 * best['energy_ratio_limit']:.4g} % allowed"
    )
    if "balls" in best:
        yield from _flown(best, objective)
    else:
        yield from _regular(best)
    errors = best.get("gradient_stderr", {})
    gradient = ", ".join(
        f"{name} {slope:.3g}" + (f" +- {errors[name]:.2g}" if name in errors else "")
        for name, slope in best["gradient"].items()
    )
    interior = best["stopped"] == "maximum"
    held = ", ".join(best["active"]) or ("nothing, an interior optimum" if interior else "nothing")
    why = {
        "noise": "no step gains more than the standard error, which hides a slope",
        "slope": "no ensemble further along the slope was higher",
        "refused": "no ensemble about it was on one motion and as high",
        "outdone": "other candidates promised more",
        "supremum": "the objective rises up to the end of the orbit: a supremum that no orbit attains",
        "ensembles": "all of them spent",
        "evaluations": "all of them spent",
        "stalled": "no step is higher though the gradient is not zero: a kink",
    }
    counted = "ensembles" if "balls" in best else "evaluations"
    yield f"  stopped after {best[counted]} {counted}: {why.get(best['stopped'], best['stopped'])}"
    yield f"  held by: {held}"
    smooth = ", of a smoothed minimum" if objective == "worst" else ""
    yield f"  log-gradient at the end{smooth}: {gradient}"


def _flown(best: dict[str, Any], objective: str) -> Iterator[str]:
    """Say what proves a motion that is no orbit."""
    exponent = f"; Lyapunov exponent {best['lyapunov']:.3g} a period" if np.isfinite(best["lyapunov"]) else ""
    yield f"  {best['balls']} balls flown for {best['periods']:,} periods each at exactly these values{exponent}"
    if best["predicted"] > (1 + _LESS) * best["height"]:
        predicted, measured = (_objective(best[name], objective) for name in ("predicted", "height"))
        yield f"  predicted {predicted} by shorter flights; this one measures {measured}"
    if best["kept_limits"] < 1:
        yield f"  {100 * best['kept_limits']:.4g} % of them kept the limits"
    if len(best["shares"]) > 1:
        shares = ", ".join(f"{name} {100 * share:.3g} %" for name, share in list(best["shares"].items())[:_MOST_ROWS])
        yield f"  they ended on: {shares}"


def _regular(best: dict[str, Any]) -> Iterator[str]:
    """Say what proves an orbit."""
    modulus = ", ".join(f"{np.hypot(*one):.4g}" for one in best["multipliers"])
    yield f"  |multipliers| {modulus}; condition of I - DP {best['condition']:.4g}; residual {best['residual']:.1e}"
    room = best["clearance"]
    yield (
        f"  clear of grazing: slowest impact {room['speed']:.4g}, room in flight {room['flight']:.4g}, "
        f"in contact {room['contact']:.4g}, slowest exit over its entry {room['exit']:.4g}"
    )


def _off_design(extents: list[dict[str, Any]], arrival: dict[str, Any] | None) -> Iterator[str]:
    """Say how far the motion lasts, what comes after it, and how balls arrive at it."""
    for one in extents:
        for way in ("below", "above"):
            side = one[way]
            if side["lasts"]:
                yield f"  {one['name']} {way}: the same motion as far as {side['percent']:.3g} % off"
                continue
            narrow = f", narrower than {_NARROW:g} %" if side["percent"] < _NARROW else ""
            kept = "within the limits" if side["admissible"] else "beyond the limits"
            yield (
                f"  {one['name']} {way}: lasts {side['percent']:.3g} %{narrow}; then {side['label']}, "
                f"with P {amount(side['P'], 'J', 4)}, {kept}"
            )
    if arrival is not None:
        when = ""
        if np.isfinite(arrival["median"]):
            when = f", half of these within {arrival['median']:.0f} periods, 90 % within {arrival['most']:.0f}"
        yield f"  {100 * arrival['share']:.3g} % of the balls arrive there in {arrival['periods']:,} periods{when}"


def _around(around: dict[str, Any] | None, rate: float) -> Iterator[str]:
    """Say what attracts at the best design; `rate` is the watts of a joule per half period."""
    if around is None:
        return
    if around["below"]:
        yield f"  nearest bifurcation along omega0: below, {_edge(around['below'])}; above, {_edge(around['above'])}"
    yield f"  basin of the motion: {100 * around['share']:.4g} % of the starts; all attractors there:"
    shown = around["attractors"][:_MOST_ROWS]
    for one in shown:
        flaw = "" if one["admissible"] else "  inadmissible"
        gives = f"P {amount(one['P'], 'J', 5)}, {amount(one['P'] * rate, 'W', 5)}"
        yield f"    {one['label']:<18}{100 * one['share']:>8.3g} %   {gives}{flaw}"
    if len(around["attractors"]) > len(shown):
        yield f"    and {len(around['attractors']) - len(shown)} more"


def _in_plane(plane: dict[str, Any] | None) -> Iterator[str]:
    """Say what bounds the optimum in the plane of two tolerances."""
    if plane is None:
        return
    names, spreads = plane["names"], plane["spreads"]
    both = " and ".join(f"{name} +-{100 * spread:.3g} %" for name, spread in zip(names, spreads, strict=True))
    yield f"  in the plane of {both}, {plane['curves']} curves of bifurcations and limits:"
    for what, one in (("bifurcation", plane["nearest"]), ("limit", plane["limit"])):
        if one is None:
            reach = ", ".join(f"{name} {low:.5g} to {high:.5g}" for name, (low, high) in plane["within"].items())
            yield f"    nearest {what}: none within {reach}"
            continue
        where = ", ".join(f"{name} {off:+.3g} %" for name, off in zip(names, one["percent"], strict=True))
        yield f"    nearest {what}: {one['kind']}, {one['times']:.3g} times the tolerances away, at {where}"


def _edge(edge: dict[str, Any]) -> str:
    if edge["kind"] == "none":
        return f"none within {abs(edge['percent']):.3g} %"
    return f"{edge['kind']} {abs(edge['percent']):.3g} % off at {edge['omega0']:.6g} rad/s"


def _height(one: dict[str, Any], objective: str) -> str:
    """Write the objective there: worst 51.78932 uJ."""
    return f"{objective} {_objective(one['height'], objective, 7)}"


def _objective(value: float, objective: str, digits: int = 4) -> str:
    """Write a value of an objective: 51.78932 uJ."""
    return amount(value, {"power": "W", "speed": "m/s"}.get(objective, "J"), digits)


def _others(best: dict[str, Any], others: list[dict[str, Any]], objective: str) -> Iterator[str]:
    yield f"other local optima: {len(others) or 'none'}"
    for one in others[:_MOST_ROWS]:
        tuned = ", ".join(quantity(name, value) for name, value in one["values"].items())
        tie = "  an exact tie" if abs(one["height"] / best["height"] - 1) < _TIE else ""
        yield f"  {tuned}: {one['label']}, {_height(one, objective)}, {_held(one)}{tie}"


def _off(report: dict[str, Any]) -> Iterator[str]:
    spread = report["spread"]
    if spread is None:
        return
    said = ", ".join(f"{one['name']} +-{100 * one['spread']:g} % {one['kind']}" for one in report["tolerances"])
    yield f"under tolerances ({said}):"
    nominal = report["best"]["P"]
    counted = _counted(spread)
    for name in ("mean", "worst"):
        gives = f"{amount(spread[name], 'J')}, {amount(spread[name] * report['best']['power'] / nominal, 'W')}"
        yield f"  {name} P {gives}, {100 * spread[name] / nominal:.4g} % of nominal{counted[name]}"
    shares = ", ".join(f"{100 * spread[name]:.3g} % {text}" for name, text in _LOSSES.items())
    yield f"  of the devices, {shares}"
    yield from _ahead(report)


def _counted(spread: dict[str, Any]) -> dict[str, str]:
    """Say how devices count that lose the motion or are inadmissible: by that the worst P may exceed the mean."""
    lost = " or ".join(text for name, text in _LOSSES.items() if spread[name])
    return {
        "mean": f", those that {lost} counting nothing" if lost else "",
        "worst": ", inadmissible ones counting what they give" if spread["inadmissible"] else "",
    }


def _ahead(report: dict[str, Any]) -> Iterator[str]:
    """Say which other optimum gives more under tolerances, whatever the motion of its devices is there."""
    first = next(iter(report["ranking"]), None)
    if first is None or not first["optimum"]:
        return
    other = report["others"][first["optimum"] - 1]
    tuned = ", ".join(quantity(name, value) for name, value in other["values"].items())
    own = next(one for one in report["ranking"] if not one["optimum"])
    yield (
        f"  another optimum gives more there: {tuned}, {other['label']}, mean P {amount(first['mean'], 'J', 5)} "
        f"where this one's devices give {amount(own['mean'], 'J', 5)}, whatever their motion"
    )


def _unconstrained(report: dict[str, Any]) -> Iterator[str]:
    peak, best = report["highest"], report["best"]
    if peak is None or peak["admissible"] or (best is not None and peak["P"] <= best["P"]):
        return
    more = f"{peak['P'] / best['P']:.4g} times as much, " if best else ""
    beyond = "not physical" if peak["unphysical"] else "beyond your limits"
    yield (
        f"{beyond}: P alone would choose {quantity(peak['along'], peak['value'])} with {amount(peak['P'], 'J')}, "
        f"{more}{1e3 * peak['max_penetration']:.4g} mm deep, "
        f"{peak['energy_ratio']:.4g} times the energy that an impact gives"
    )


def table(report: dict[str, Any]) -> Iterator[str]:
    """Tell the best designs along an axis, a line each: `over` is its name and values, `designs` of `describe` each."""
    checks.record("report", report, ("over", "designs"), "scripts/design.py --over")
    name, values = report["over"]["name"], report["over"]["values"]
    for value, one in zip(values, report["designs"], strict=True):
        best = one["best"]
        if best is None:
            yield f"{name} {value:.5g}: no admissible motion; {next(_instead(one['survey']))}"
            continue
        tuned = ", ".join(quantity(*item) for item in best["values"].items())
        spread = f", at worst {amount(one['spread']['worst'], 'J', 5)}" if one["spread"] else ""
        gives = f"P {amount(best['P'], 'J', 5)}, {amount(best['power'], 'W', 5)}"
        yield f"{name} {value:.5g}: {tuned}, {best['label']}, {gives}{spread}, {_held(best)}"


def _held(best: dict[str, Any]) -> str:
    return ", ".join(best["active"]) or ("interior" if best["stopped"] == "maximum" else best["stopped"])
