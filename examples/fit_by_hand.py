"""A model fitted from Python: what `slip model fit` does.

slip analyze run.mcap && python examples/fit_by_hand.py results RUN effective_track drive_lag
"""

import sys

import slip

results, name, *effects = sys.argv[1:]
run = slip.load(name, results=results)
model = slip.Model(run.vehicle)
for effect in effects:
    model += effect
print(model.fit(run, input="command"))
