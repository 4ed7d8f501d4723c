"""Every effect is said in one plain sentence: its name, its quantities with units."""

import msgspec

from pipeline.models import find_effect, list_effects
from pipeline.sources import Vehicle, list_presets

PRESETS: dict[str, Vehicle] = {vehicle.id: vehicle for vehicle in list_presets()}
HUSKY, CAR = PRESETS["husky_a200"], PRESETS["ackermann_car"]
MOST_IN_SENTENCE = 3


def test_every_effect_has_a_sentence_of_its_own_that_moves_with_its_numbers() -> None:
    for kind in list_effects():
        vehicle = next(v for v in (HUSKY, CAR, PRESETS["dingo_o"]) if v.kind in kind.kinds)
        usual = {p.name: p.typical for p in kind.parameters if not p.instead_of}
        effect = kind().change(**usual)
        sentence = effect.describe_motion(vehicle)
        assert sentence
        assert kind.id not in sentence
        assert "nan" not in sentence
        assert len(sentence) < 100
        if len(usual) > MOST_IN_SENTENCE:
            # Its numbers stand below the sentence, one in each line with its interval.
            assert not set(usual) & set(sentence.split())
            continue
        for parameter in kind.parameters:
            if parameter.instead_of:
                continue
            low, high = parameter.bounds
            other = min(max(1.7 * parameter.typical, low), high)
            assert effect.change(**{parameter.name: other}).describe_motion(vehicle) != sentence, (
                parameter.name
            )


def test_no_metres_are_said_of_a_vehicle_of_which_only_the_body_motion_is_known() -> None:
    stand_in = msgspec.structs.replace(HUSKY, stand_ins=["track_width_m"])
    assert find_effect("effective_track")().change(k=1.08).describe_motion(stand_in) == (
        "Effective track 1.08 times the controller's: the robot turns at 93 % of the ideal rate"
    )
