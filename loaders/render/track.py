"""The track of rigs, ``fpp-bench-rigs``: sixteen rigs that a lab could own, each in two lights, as
one dataset each, to measure a method that is made for any rig.

A dataset ``rig-03-workshop`` has two views of six unseen objects, scaled with the rig's working
volume, and stores what a method of one frame reads: the crossed frames that ``fpp-bench design``
proposes for the rig, and the first frame of both directions. The rig that photographs is not the
one that is stated: a calibration error lies between them, 0.1 px for half of the rigs.
``benchmarks/draw_rigs.py`` drew the rigs. They are for measuring, never for choosing.
"""

import json
from functools import cache
from pathlib import Path

from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.scene import BuildSettings, light_of_volume, volume_scale
from fpp_ml_bench.optics.rig_file import rig_from_dict

TRACK = "rigs"
"""Name of the preset; the version is that of `storage.benchmark.TRACK`."""
RIGS_FILE = Path(__file__).with_name("track_rigs.json")
TRACK_LIGHTS = ("paper", "workshop")
TRACK_VIEWS = (VIEWS[0], VIEWS[2])
TRACK_OBJECTS = ("blob", "gear", "hollow_cube", "stair_tower", "torus_knot", "turbine_blade")
"""Of the unseen objects: smooth ones, steps, hollows, holes and thin parts."""


@cache
def track() -> dict[str, BuildSettings]:
    """Settings of the track's datasets by name, ``rig-01-paper`` first."""
    settings = {}
    for number, entries in enumerate(json.loads(RIGS_FILE.read_text(encoding="utf-8")), 1):
        calibration_px = entries.pop("calibration_px")
        rig = rig_from_dict(entries)
        scale = volume_scale(rig)
        for name in TRACK_LIGHTS:
            light = light_of_volume(named_light(name), rig, scale)
            settings[f"rig-{number:02d}-{name}"] = BuildSettings(
                rig,
                TRACK_OBJECTS,
                stored="first_frames",
                seed=number,
                light=light.changed(calibration_px=calibration_px),
                object_scale=scale,
                views=TRACK_VIEWS,
            )
    return settings
