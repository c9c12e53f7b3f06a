"""What a person should know of a noise fit: what it left out, and sentences on what its numbers are."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from udccal.fitting.engine.misfit import group_means_test
from udccal.fitting.engine.robust import outliers
from udccal.fitting.noise.codes import converter_step
from udccal.fitting.noise.flats import Curve
from udccal.fitting.noise.frame_moments import MIDDLE_ROWS, Picture, Shared
from udccal.fitting.noise.moments import NoiseMoments
from udccal.fitting.noise.patterns import DarkTerms, Pattern, rough_median
from udccal.result import Outliers

_PRNU_BY_CURVE = "PRNU1288 holds for the photon transfer curve as fitted, which the variances do not follow."


def left_out(data: NoiseMoments, dark: DarkTerms, curve: Curve, uneven: Pattern, end_DN: float) -> Iterator[Outliers]:
    """Samples that are left out, by rule; some of these are empty. ``end_DN`` is saturation."""
    names = _names(data)
    # Unclipped samples stand out among clipped ones; that is no defect.
    ceiling = end_DN - 0.1 * (curve.ceiling_DN - dark.black_DN)
    seen = (*(flat for flat in data.flats if float(flat.mean_DN.max()) < ceiling), *data.dark_moments)
    hits, sigma = sum(moments.outliers for moments in seen), f"{data.rules.outlier_sigma:g} robust sigma"
    yield Outliers(f"two codes of a pixel {data.rules.hit_sigma:g} sigma apart in a pair (hits, blinking pixels)", hits)
    yield from outliers(f"flats of a pair that differ in brightness by {sigma}", (names[i] for i in curve.flickering))
    off_response = np.flatnonzero(np.isnan(curve.levels.light) & ~np.isnan(curve.inside.light))
    yield from outliers(f"brightness off the response by {sigma}", (names[i] for i in off_response))
    bins = int(np.sum(curve.inside.usable & ~curve.levels.usable))
    yield Outliers(f"bins of flats off the photon transfer curve by {sigma}", bins)
    for what, beside, found in (("dark", "(hot)", dark.offsets), ("flat", "their surroundings", uneven)):
        places = tuple(f"row {row}, column {column}" for row, column in found.places)
        rule = f"averaged {what} pixels {data.rules.defect_sigma:g} robust sigma off {beside}"
        yield Outliers(rule, found.outliers, places)


def _names(data: NoiseMoments) -> list[str]:
    return [*(f"flat {i} ({flat.exposure_s:.4g} s)" for i, flat in enumerate(data.flats)), "flat stack"]


def notes(
    data: NoiseMoments, dark: DarkTerms, curve: Curve, uneven: Pattern, shared: Shared,
    values: Float[np.ndarray, "11"],
) -> Iterator[str]:  # fmt: skip
    """Sentences for a person; ``values`` are the estimates."""
    if not (curve.full.any() or curve.pile):
        what = "as many bits as the codes have (top_code was not given)" if data.top_guessed else "the converter"
        yield f"No flat reached saturation; the largest code of {what}, {values[2]:.0f} DN, is taken for it."
    if not dark.white:
        found = "Rounding or cut-off codes bend the dark codes: black, dark noise, row noise, dark current and DSNU"
        yield f"{found} come from histograms, and hold for read noise of the model's kind (Tukey's lambda)."
    if len({pair.exposure_s for pair in data.darks}) < 2:
        yield "Dark frames of one exposure time do not tell dark current from black: black holds both."
    if uneven.structure2 > 0:
        found = f"Flats vary by {100 * uneven.structure2**0.5:.2g} % between pixels, but not as white noise does."
        yield f"{found} That counts as light, as a panel's; columns or blotches of the sensor are not in PRNU1288."
    signal = data.flat_stack.mean_DN.astype(np.float32) - np.float32(dark.black_DN)
    if data.period == 1 and (apart := _sites_apart(signal)) > 0:
        found = f"The light of the 2 x 2 sites of neighbouring pixels differs by {100 * apart:.2g} %"
        yield f"{found}: the frames look like a colour mosaic, and PRNU1288 is then wrong. Give bayer=True."
    yield from _of_darks(data, dark)
    if len(missing := _missing_codes(data)):
        found = f"{len(missing)} codes between others never occur (the first is {missing[0]})"
        cause = (
            "the converter's steps are uneven, and noise of a few codes, black and saturation are those of its codes"
        )
        yield f"{found}: {cause}."
    yield from _of_steps(data)
    if (test := curve.fit.misfit).found:
        found = f"Variances scatter {test.ratio:.2g} times as much about the photon transfer curve as noise does"
        yield f"{found} (p = {test.p_value:.1g}); the sigmas of K, sigma_d, dark current and DSNU include that."
        yield _PRNU_BY_CURVE
        if (by_place := _gain_by_place(curve)) > 0:
            cause = "as where the camera corrects its lens's shading: switch that off"
            yield f"K differs by {100 * by_place:.2g} % from place to place on the sensor, {cause}."
    if curve.fit.order.gain_noise:
        found = f"Pixels have noise of {100 * curve.values[5] ** 0.5:.2g} % of their signal beside shot noise"
        cause = "from the pixels' gain or a lamp whose pattern changes"
        yield f"{found}, {cause}: K is that of small signals, and the noise of bright ones is more than the term says."
    if (end := curve.off_its_end) is not None:
        found = (
            f"All variances of {_names(data)[end]}, the brightest inside the range, are off the photon transfer curve"
        )
        yield f"{found}: the response bends there. The sigmas include by how much dimmer flats differ from the others."
        yield _PRNU_BY_CURVE
    if shared.found:
        found = f"(correlation {shared.along_row:.2g} along rows, {shared.along_column:.2g} along columns)"
        yield (
            f"Neighbouring pixels share their noise {found}, as where a camera filters its frames. The true K is about "
            f"{shared.gain_factor:.3g} times the one found; all numbers in electrons change with it."
        )
    if curve.fit.order.curved:
        yield f"The response bends: {100 * values[-1]:.2g} % of the signal is missing at full scale."
    if curve.fit.order.cubic:
        # The term's parabola meets the response at full scale: the difference, d z^2 (full - z), is largest at 2/3.
        off = 4 / 27 * float(curve.values[6]) * (values[2] - values[1]) ** 2
        found = "It is no parabola, and the term's parabola is right for small signals and at full scale"
        yield f"{found}: in between, signals are off by up to {100 * abs(off):.2g} % of full scale."
    if curve.fit.at_bound:
        yield "The response bends more than the model can describe. Check the exposures and the lamp."
    if curve.fit_up_to < 0.9:
        yield f"Flats above {100 * curve.fit_up_to:.0f} % of saturation do not follow the curve and are left out."
        if rough_median(data.flat_stack.mean_DN) - dark.black_DN > curve.fit_up_to * (curve.ceiling_DN - dark.black_DN):
            yield "The flat stack is brighter than that: PRNU1288 holds for a curve that goes on."
    if curve.fit.order.unsteady:
        found = f"The light differs by {100 * curve.fit.scatter:.2g} % from level to level"
        yield f"{found}{', or the response bends otherwise and K is off' * curve.fit.order.cubic}."


def _gain_by_place(curve: Curve) -> float:
    """Relative scatter of the gain over the sensor; 0 where its parts do not explain most of the misfit."""
    use, z = curve.levels.usable, np.nan_to_num(curve.fit.variance_z)
    scale, part = curve.fit.misfit.ratio, np.broadcast_to(np.arange(use.shape[1]), use.shape)
    test = group_means_test(z.ravel(), part.ravel(), use.ravel(), scale)
    groups = use.any(axis=0)
    explained = test.ratio * scale * np.count_nonzero(groups)
    if not test.found or explained < 0.5 * float(np.sum(z[use] ** 2)):
        return 0.0
    # Shot noise is most of the variance of flats: a part's variances are off by the same fraction at all levels.
    off = np.where(use, z * np.sqrt(2 / np.maximum(curve.levels.dof, 1.0)), 0.0)
    return float((off.sum(axis=0)[groups] / use.sum(axis=0)[groups]).std())


def _of_darks(data: NoiseMoments, dark: DarkTerms) -> Iterator[str]:
    """Sentences on noise and pixels that the model does not describe."""
    if dark.foreign:
        yield "Read noise has heavier or lighter tails than the model's: sigma_d is the root mean square of all pixels."
    if dark.skewed:
        found = "Read noise or dark current has one tail, which the model's has not"
        yield f"{found}: black and dark current are those of the mean code of all pixels."
    if dark.rows.banded and dark.row_DN2.there:
        found = f"Rows share noise of {dark.row_DN2.value**0.5:.2g} DN in bands, as of a supply"
        count = f"{dark.rows.independent:.2g}"
        yield f"{found}: the noise term takes rows for independent, and sigmas are those of {count} rows."
    if dark.columns.DN2.there:
        found = f"Columns share noise of {dark.columns.DN2.value**0.5:.2g} DN that changes from frame to frame"
        yield f"{found}: it is a part of sigma_d, and the noise term takes it for noise of single pixels."
    if own := dark.own_shot_DN2_per_s:
        K = dark.K_DN_per_e
        found = f"The noise of dark frames grows as that of {own.value / K**2:.3g} e/s, their mean by"
        yield (
            f"{found} {dark.dark_DN_per_s.value / K:.3g} e/s: the camera compensates dark current, or its black "
            "changes with exposure. sigma_d is by the noise; the term has the mean's dark current, whose sigma holds "
            "both."
        )
    if dark.drift_DN_per_s:
        found = f"Means of dark frames bend over exposures, by {dark.drift_DN_per_s / dark.K_DN_per_e:.2g} e/s"
        yield f"{found}: dark current or black drifted. Take dark frames once they are stable, or in random order."
    if dark.unsteady_DN:
        found = f"The mean of dark frames is off black and dark current by {dark.unsteady_DN:.2g} DN"
        yield f"{found} from exposure to exposure; the sigmas of black, dark current and saturation include that."
    size = data.flat_stack.mean_DN.size
    hot = max(1 - data.dark_samples / (len(data.darks) * size), dark.offsets.outliers / size)
    if hot > data.rules.most_hot:
        without = "DSNU is that" if dark.skewed else "black, dark current, sigma_d and DSNU are those"
        found = f"{100 * hot:.2g} % of dark samples are far from the others (hot or dead pixels)"
        yield f"{found}: {without} of the others."
        if not dark.white:
            yield "PRNU1288 is what is left without that DSNU: offsets of hot pixels, which rounding hides, are in it."


def _of_steps(data: NoiseMoments) -> Iterator[str]:
    """A sentence where the codes of some frames are further apart than the converter's step."""
    steps = [(converter_step(of.codes, 8) or data.q_DN, of.level_DN) for of in (*data.flats, *data.dark_moments)]
    if coarse := [level for step, level in steps if step > data.q_DN]:
        found = f"Codes are {data.q_DN} DN apart, but {max(steps)[0]} DN in frames of {min(coarse):.4g} DN and others"
        yield f"{found}: the converter's step is not the same at all signals, and q_DN is the smallest."


def _missing_codes(data: NoiseMoments) -> Int[np.ndarray, " missing"]:
    """Codes that no flat has although it has many samples of codes on both sides, and noise of some codes."""
    near, missing = 8, np.zeros(0, int)
    for flat in data.flats:
        if float(flat.variance_DN2.min()) > (0.5 * near * data.q_DN) ** 2:
            codes = np.pad(flat.codes[:: data.q_DN], near)
            most = np.lib.stride_tricks.sliding_window_view(codes, near).max(axis=1)
            beside = np.minimum(most[: -near - 1], most[near + 1 :])
            missing = np.union1d(missing, np.flatnonzero((codes[near:-near] == 0) & (beside >= 100)) * data.q_DN)
    return missing


def _sites_apart(signal_DN: Picture) -> float:
    """How much the light of the brightest site of 2 x 2 exceeds that of the dimmest, relative; 0 where that is chance.

    The rows in the middle are enough. Rows or columns read out with two gains differ by less than a twentieth.
    """
    start = max((len(signal_DN) - MIDDLE_ROWS) // 4, 0) * 2
    sites = [signal_DN[start + row : start + MIDDLE_ROWS : 2, column::2] for row in (0, 1) for column in (0, 1)]
    light, spread = np.array([(float(one.mean()), float(one.std()) / one.size**0.5) for one in sites]).T
    apart = float(np.ptp(light))
    return apart / float(light.mean()) if apart > max(0.05 * abs(light.mean()), 10.0 * spread.max()) else 0.0
