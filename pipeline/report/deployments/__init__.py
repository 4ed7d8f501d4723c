"""The deployment map on one offline page: kinetic energy against terrain complexity.

The literature by kind of model, bounds as arrows, doubtful rows hollow; own datasets coloured by their slip.
"""

from pipeline.report.deployments.page import picture_map, render_map
