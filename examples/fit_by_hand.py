"""A model fitted from Python: what `slip model add` does, in ten lines.

slip analyze run.mcap && python examples/fit_by_hand.py results RUN effective_track drive_lag
"""

from __future__ import annotations

import sys
from pathlib import Path

from pipeline.identification import Input, Problem, climb
from pipeline.models import Model, find_effect
from pipeline.report.motion_run import load_motion_run, load_vehicle
from pipeline.store import Store

results, run, *effects = sys.argv[1:]
manifest = Store(Path(results)).manifest(run)
if manifest is None:
    sys.exit(f"there is no run {run!r} in {results}")
vehicle = load_vehicle(manifest)
problem = Problem([load_motion_run(manifest, vehicle)], vehicle, Input.COMMAND)
ladder = climb(problem, Model(vehicle, tuple(find_effect(name)() for name in effects)))
for rung in ladder.rungs:
    names = ", ".join(map(repr, rung.fitted.model.effects)) or "ideal"
    print(f"{names:<60} {rung.errors.t_mrmse_m:.3f} m  {rung.errors.r_mrmse_rad:.3f} rad over 2 s")
