"""Effects written as formulas: units, a small parser that never evaluates text, and the effect itself.

A formula is arithmetic over named signals and the effect's own parameters; its unit is worked out and must be
that of the velocity it adds to.
"""

from pipeline.motion.formula.expression import Expression, parse_expression
from pipeline.motion.formula.formula_effect import SIGNAL_UNITS, FormulaEffect
from pipeline.motion.formula.units import Unit, parse_unit

__all__ = ["SIGNAL_UNITS", "Expression", "FormulaEffect", "Unit", "parse_expression", "parse_unit"]
