"""The stated tests, and what all of it means, in plain words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from nnss_cli.datasets.record import Channels, FloatArray
from nnss_cli.datasets.units import p_text
from nnss_cli.trained.simulate import Beyond
from nnss_cli.validation.gain import ALONE, INCREMENTS
from nnss_cli.validation.linearisation import Linearisations
from nnss_cli.validation.predictor import StepTable
from nnss_cli.validation.residuals import LEVEL, Whiteness
from nnss_cli.validation.result import OutputCheck, Stated

COLOURED = 0.2  # a correlation at lag 1 that is worth a word
MATTERS = 0.05  # share of the residuals' variance that a profile must explain to be told
UNAIDED = "none does: what is predicted here is a regression on increments"
ELSEWHERE = 0.05  # share of a record beyond the range of training from which that may be what residuals show
CLOSE = 2.0  # percent of fit: as good as the linear limit


def stated(
    outputs: Sequence[OutputCheck], steps: StepTable, rates: Sequence[float], origins: Sequence[str], channels: Channels
) -> tuple[Stated, ...]:
    """The tests that a model passes or fails.

    The first two have the level of 1 %, shared by outputs and inputs; the others have none.
    """
    m, r = len(outputs), len(channels.inputs)
    tests = []
    worst = min(outputs, key=lambda each: each.white.p_value)
    tests.append(
        Stated(
            "residuals are white (Li-McLeod)",
            worst.white.p_value >= LEVEL / m,
            f"{p_text(worst.white.p_value)} ('{worst.name}', {_colour(worst.white)})",
        )
    )
    p, output, name = min(
        (found.p_value, each.name, channels.inputs[j]) for each in outputs for j, found in enumerate(each.depends)
    )
    tests.append(
        Stated("residuals do not depend on the inputs", p >= LEVEL / (m * r), f"{p_text(p)} ('{output}' on '{name}')")
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(steps.persistence[0] > 0, steps.predicted[0] / steps.persistence[0], np.inf)
    worst_output = int(np.argmax(ratio))
    tests.append(
        Stated(
            "one step ahead, the model beats persistence",
            bool(ratio[worst_output] < 1),
            f"RMSE {ratio[worst_output]:.2f} times that of persistence ('{channels.outputs[worst_output]}')",
        )
    )
    corrected = [rate for rate, origin in zip(rates, origins, strict=True) if origin != "none"]
    if corrected:
        tests.append(
            Stated(
                "the observer is stable",
                max(corrected) < 1,
                f"its errors change by a factor of {max(corrected):.3g} a sample",
            )
        )
    if any(origin in (INCREMENTS, ALONE) for origin in origins):
        tests.append(Stated("on validation, a gain of the model beats persistence", False, UNAIDED))
    return tuple(tests)


def verdict(
    outputs: Sequence[OutputCheck],
    steps: StepTable,
    tests: Sequence[Stated],
    order: int,
    poles: FloatArray,
    channels: Channels,
    linear: Linearisations,
    integrators: int,
    beyond: Sequence[Beyond] = (),
) -> tuple[str, ...]:
    """Sentences, the most important first.

    Args:
        outputs: what was found of each.
        steps: errors ahead.
        tests: those stated.
        order: number of states n.
        poles: eigenvalues of A(x) (points, n) along the trajectory.
        channels: names and units.
        linear: linearisations at equilibria.
        integrators: how many of the eigenvalues are 1 by choice.
        beyond: signals that leave the range of the training records.
    """
    lines = [
        f"'{one.channel}' leaves the range of the records fitted to, {one.trained[0]:.4g} to {one.trained[1]:.4g}, at "
        f"{one.samples} of {one.of} samples ({one.found[0]:.4g} to {one.found[1]:.4g}): no data speak for the model "
        "there."
        for one in beyond
    ]
    elsewhere = any(one.samples > ELSEWHERE * one.of for one in beyond)
    advice = "or it is the range that none was fitted to" if elsewhere else f"try order {order + 1}"
    for index, each in enumerate(outputs):
        lines += _dynamics(each, len(outputs), advice, channels)
        lines += _limit(each)
        lines += _profiles(each, channels)
        if steps.predicted[0, index] >= steps.persistence[0, index]:
            lines.append(
                f"'{each.name}': persistence predicts the next sample better than the model: look for an operating "
                "range that training did not have, or an offset."
            )
    if any(test.found == UNAIDED for test in tests):
        lines.append(
            "How inputs and outputs move tells the next sample better than this model: do not rely on its levels, and "
            "read the tests of residuals as those of the regression."
        )
    if integrators:
        lines.append(
            f"The outputs integrate: {integrators} of {order} eigenvalues of A(x) are exactly 1, by choice "
            "(--integrator). What is promised of stability is of the LPV part before the sum."
        )
    # rounding may move an integrator's, so the nearest to 1 are taken for them
    apart = np.take_along_axis(poles, np.argsort(np.abs(poles - 1), axis=1)[:, integrators:], axis=1)
    if (radius := float(np.abs(apart).max(initial=0.0))) >= 1:
        lines.append(f"A(x) has an eigenvalue of modulus {radius:.4g} on the trajectory: the model is not Schur there.")
    lines += _signs(linear, channels)
    if integrators and linear.without:
        lines.append("No linearisation at equilibria: under a constant input the outputs drift, as an integrator's do.")
    else:
        lines += [f"No linearisation: {reason}." for reason in linear.without]
    failed = sum(not test.passed for test in tests)
    head = f"{failed} of {len(tests)} tests fail." if failed else f"All {len(tests)} tests pass."
    return (head, *lines)


def _dynamics(each: OutputCheck, m: int, advice: str, channels: Channels) -> Iterator[str]:
    own = f"'{each.name}': "
    depends = [
        channels.inputs[j] for j, found in enumerate(each.depends) if found.p_value < LEVEL / (m * len(each.depends))
    ]
    on = " and on ".join(f"'{name}'" for name in depends)
    coloured = each.white.p_value < LEVEL / m
    if depends:
        colour = f"coloured ({_colour(each.white)}) and " if coloured else ""
        yield f"{own}residuals are {colour}dependent on {on}: dynamics are missing; {advice}."
    elif coloured:
        yield (
            f"{own}residuals are coloured, {_colour(each.white)}, though independent of the inputs: dynamics of the "
            f"disturbance are missing; {advice}."
        )
    elif abs(each.simulation_r1) > COLOURED:
        yield (
            f"{own}residuals are white, while the simulation's errors are coloured (r1 = {each.simulation_r1:.2f}): "
            "the predictor makes up for what the simulation lacks, a disturbance or what the model does not have."
        )
    blamed = [channels.inputs[j] for j, p in enumerate(each.simulation_depends) if p < LEVEL / (m * len(each.depends))]
    if blamed and not depends:
        yield (
            f"{own}the simulation's errors depend on {' and on '.join(repr(name) for name in blamed)}: part of the "
            f"response is missing, which the predictor makes up for; {advice}."
        )


def _signs(linear: Linearisations, channels: Channels) -> Iterator[str]:
    for i, output in enumerate(channels.outputs):
        for j, name in enumerate(channels.inputs):
            gains = [(point.dc_gain[i, j], point.u[j]) for point in linear.points if np.isfinite(point.dc_gain[i, j])]
            if gains and min(gains)[0] < 0 < max(gains)[0]:
                (low, at_low), (high, at_high) = min(gains), max(gains)
                yield (
                    f"The steady-state gain from '{name}' to '{output}' changes its sign: {low:.3g} at {at_low:.4g}, "
                    f"{high:.3g} at {at_high:.4g}; if the plant's does not, the model is not to be trusted at rest."
                )


def _limit(each: OutputCheck) -> Iterator[str]:
    """A linear model that was fitted to the record proves its fit; coherence alone is an estimate, of other relations,
    too."""
    if each.limit is None:
        return
    own, most = f"'{each.name}': the simulation fits {each.fit_percent:.1f} %", f"{each.limit:.1f} %"
    if proved := each.reached is not None and each.reached >= each.limit - CLOSE:
        what = f"{most} that a linear model reaches which is fitted to this very record"
    else:
        best = "none was fitted" if each.reached is None else f"the best that was fitted reaches {each.reached:.1f} %"
        what = f"{most} that coherence leaves for linear relations, which need not be a model's ({best})"
    if each.fit_percent > each.limit + CLOSE:
        yield f"{own}, more than the {what}: the nonlinearity pays."
    elif each.fit_percent < each.limit - CLOSE:
        yield f"{own}, below the {what}: there {'is' if proved else 'may be'} something left to be had."
    else:
        yield f"{own}, near the {what}. Those fitted to training data may be far below it: 'nnss compare' shows it."


def _profiles(each: OutputCheck, channels: Channels) -> Iterator[str]:
    named = [(f"input '{name}'", found) for name, found in zip(channels.inputs, each.by_input, strict=True)]
    named += [(f"state x{i + 1}", found) for i, found in enumerate(each.by_state)]
    count = len(named)
    telling = [
        (found.share, what)
        for what, found in named
        if found is not None and found.p_value < LEVEL / count and found.share > MATTERS
    ]
    if telling:
        share, what = max(telling)
        yield (
            f"'{each.name}': the mean residual bends with {what} ({100 * share:.0f} % of its variance, beyond a "
            "straight line): a nonlinearity is missing there."
        )


def _colour(white: Whiteness) -> str:
    """r1, or a larger correlation among the lags tested where r1 lies within its band."""
    r = white.correlation[: white.lags]
    lag = 0 if abs(r[0]) > white.band else int(np.argmax(np.abs(r)))
    return f"r{lag + 1} = {r[lag]:.2f}"
