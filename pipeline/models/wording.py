"""Words that the sentences of effects share."""


def name_side(value: float) -> str:
    """The side that a number is on which counts to the left."""
    return "left" if value >= 0.0 else "right"


def describe_share(gain: float) -> str:
    """How much less or more than one a gain is: `29 % less`."""
    return f"{abs(1.0 - gain):.0%} {'less' if gain <= 1.0 else 'more'}"
