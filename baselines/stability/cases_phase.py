"""Phase: dim, saturated, non-linear, coarsely quantised, few or unequal steps, dead frames, fine and wide fringes."""

from fpp_ml_bench.baselines.stability import phase_checks as check
from fpp_ml_bench.baselines.stability.case import Case, family

MODULATIONS = (100.0, 30.0, 10.0, 5.0, 3.0, 1.0, 0.3, 0.1)
SHARES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
CIRCLE = "the phase that the frames were made from"


def cases() -> list[Case]:
    """The cases of this group."""
    group = "phase"
    return [
        *family(
            group, "modulation, real frames", check.modulation_exact, {"modulation": MODULATIONS},
            computes="wrapped phase of 18 float64 frames", unit="rad",
            reference="least squares of the same frames in 50 digits",
            predicts="sqrt(2) 2 (N + 4 pi + 2) u (A + B) / B: N + 1 roundings a sum, 4 pi + 1 in each weight, over B",
        ),
        *family(
            group, "modulation, 8-bit frames", check.modulation_8bit, {"modulation": MODULATIONS},
            computes="absolute phase by the decoder, 8-bit frames", reference=CIRCLE, unit="rad",
            predicts="asin(g / 2B), g = max (2/N) sum |sin|: half a grey level in every frame; under 5 levels refused",
            expects=check.expects_modulation,
        ),
        *family(
            group, "modulation, noise of 1 grey level", check.noise, {"modulation": MODULATIONS},
            computes="rms error of absolute phase, 20,000 pixels", reference=CIRCLE, unit="rad",
            predicts="sqrt(2/N) sigma / B with sigma^2 = 1 + 1/12, second order 2 sigma_phi^2, 4 standard errors",
            expects=check.expects_noise,
        ),
        *family(
            group, "saturation, phase alone", check.saturation_phase, {"steps": (18, 3), "share": SHARES},
            computes="wrapped phase of frames clipped in a share of the period", reference=CIRCLE, unit="rad",
            predicts="asin(sum |c_(kN-1)| + |c_(kN+1)| over c_1): aliased harmonics of a clipped cosine, closed form",
        ),
        *family(
            group, "saturation, decoder", check.saturation_decoder, {"share": SHARES},
            computes="absolute phase by the decoder, 8-bit frames", reference=CIRCLE, unit="rad",
            predicts="as above, plus half a grey level; more than 2 clipped frames of 18 must be refused",
            expects=check.expects_saturation,
        ),
        *family(
            group, "gamma", check.gamma_bend, {"steps": (18, 4, 3), "gamma": (1.0, 1.5, 2.2, 3.0)},
            computes="wrapped phase of frames 255 (I / 255)^gamma", reference=CIRCLE, unit="rad",
            predicts="asin(sum of the harmonics kN +- 1 over the first), which N steps alias with the fringe",
        ),
        *family(
            group, "quantisation", check.quantisation, {"steps": (18, 3), "bits": (1, 2, 3, 4, 6, 8, 10, 12, 14, 16)},
            computes="wrapped phase of frames of this bit depth, B = 100", reference=CIRCLE, unit="rad",
            predicts="asin(q g / 2B), q = 255 / (2^bits - 1); pi / N where one bit leaves 2N states or N",
        ),
        *family(
            group, "few steps", check.few_steps, {"steps": (3, 4, 5, 6, 7, 9, 12, 18)},
            computes="wrapped phase of 8-bit frames, B = 100", reference=CIRCLE, unit="rad",
            predicts="asin(g / 2B), g = max (2/N) sum |sin|",
        ),
        *family(
            group, "unequal steps", check.uneven_steps, {"chosen": (3, 4, 5, 7, 8, 11, 13, 17)},
            computes="wrapped phase of this number of 18 steps, 8-bit frames", reference=CIRCLE, unit="rad",
            predicts="asin(g' / 2B), g' = max over directions of sum |least-squares weight|",
        ),
        *family(
            group, "steps close together", check.close_steps,
            {"spread_rad": (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 1e-4, 1e-8)},
            computes="wrapped phase at shifts 0, s, 2 s", unit="rad",
            reference="least squares of the same frames in 50 digits",
            predicts="8 N u cond (A + B) / B (pinv M = I to u cond) + N u ||I|| / (sigma_min B); cond > 1e6 refused",
            expects=lambda spread_rad: "number" if spread_rad > 5e-3 else "either",
        ),
        *family(
            group, "equal shifts", check.equal_steps_twice, {},
            computes="weights of the shifts 0, 1, 1 rad", reference="there is no such phase", unit="rad",
            predicts="two different shifts do not determine the phase", expects="refusal",
        ),
        *family(
            group, "dead frame", check.dead_frame, {"steps": (18, 9, 6, 4), "level": (0, 255)},
            computes="a plane's depth with one frame entirely black or white", unit="mm",
            reference="the frame's mean contradicts the N - 1 others",
            predicts="frame means follow A + C cos + S sin too; from 4 steps on the dead frame must be refused",
            expects="refusal",
        ),
        *family(
            group, "dead frame of three", check.dead_frame, {"steps": (3,), "level": (0, 255)},
            computes="a plane's depth with one of three frames black or white", reference="the plane, 1800 mm",
            predicts="no redundancy; the epipolar check allows 1.5 px across, hence 1.5 px / sin(alpha) of u",
            unit="mm", expects="either",
        ),
        *family(
            group, "repeated frame", check.repeated_frame, {"steps": (18, 9, 4)},
            computes="wrapped phase where frame 1 is frame 0 again", reference=CIRCLE, unit="rad",
            predicts="asin((2/N) 2 sin(pi/N)): one frame off by 2 B sin(pi/N) at most",
        ),
        *family(
            group, "pitch", check.pitch,
            {"pitch_px": (2.5, 3.9, 4.0, 5.3, 9.0, 18.0, 36.7, 100.0, 456.0, 912.0, 1000.0)},
            computes="projector coordinate by the decoder, 8-bit frames", reference="the coordinate of the pixel",
            predicts="P / 2 pi asin(g / 2B) over the whole pattern; under 4 px or beyond the pattern refused",
            unit="px", expects=lambda pitch_px: "number" if 4 <= pitch_px <= 912 else "refusal",
        ),
    ]  # fmt: skip
