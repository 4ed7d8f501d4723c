"""Effects written as formulas: units, a small parser that never evaluates text, and the effect itself.

A formula is arithmetic over named signals and the effect's own parameters; its unit is worked out and must be
that of the velocity it adds to.
"""

from pipeline.models.formula.expression import parse_expression
from pipeline.models.formula.formula_effect import SIGNAL_UNITS, FormulaEffect
from pipeline.models.formula.units import Unit, parse_unit
