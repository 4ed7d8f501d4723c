"""The physical effects, one file each; every file in this folder is loaded.

A file's docstring is the effect's manual page. To add an effect: copy the file nearest to it, change the
formula, and run the shared test of all effects.
"""

from pipeline.models.catalogue import find_effect, list_effects
