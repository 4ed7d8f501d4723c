"""What was noticed about a log, in words, with stable ids."""

from typing import ClassVar

import dataframely as dy

from schemas import fields
from schemas.contract import Table

SEVERITIES = ("info", "warning", "error")


class Findings(Table):
    """One row a finding."""

    VERSION: ClassVar[int] = 1

    stage = fields.text("stage that noticed it")
    id = dy.String(min_length=1, regex=r"^[a-z][a-z0-9_]*$", metadata={"description": "stable id"})
    severity = fields.choice(SEVERITIES, "info, warning, or error: do not trust results")
    text = fields.name("the finding in one sentence")
    where = fields.text("topic, column or stretch of time; empty for the whole run")
    t_start = fields.optional("s", "start of the stretch it concerns")
    t_end = fields.optional("s", "end of the stretch it concerns")
    value = fields.optional("1", "the number behind it, in the unit the text gives")
    count = fields.count("how often", nullable=True)
