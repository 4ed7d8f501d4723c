"""Names of the topics in a derived log; layouts refer to them."""

MEASURED = "/slip/velocity/measured"
MODEL = "/slip/velocity/model"
POSE = "/slip/pose"
PATH = "/slip/path"
PREDICTED_PATH = "/slip/predicted_path"
TRAIL = "/slip/trail"
SEGMENT = "/slip/segment"
FINDINGS = "/slip/findings"
FINDING_MARKERS = "/slip/finding_markers"


def name_ideal(input_name: str) -> str:
    """Topic of the ideal velocity on an input."""
    return f"/slip/velocity/ideal_{input_name}"


def name_slip(input_name: str) -> str:
    """Topic of the slip vector on an input."""
    return f"/slip/slip_{input_name}"


def name_modulus(input_name: str) -> str:
    """Topic of the slip modulus on an input."""
    return f"/slip/modulus_{input_name}"
