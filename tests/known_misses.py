"""Promises that are not kept today, each with what happens instead: what passes again leaves the list."""

MISSES = {
    "tests/models/test_motion_budget.py::test_effects_that_were_not_named_have_numbers_that_hold_the_truth":
        "an effect that was not named has a standard error 1.6 times that of one that was",
    "tests/models/test_motion_effects.py::test_a_parameter_put_into_simulated_data_comes_back[deadband]":
        "fitted without a search on motion without noise it ends 21 % off",
    "tests/models/test_motion_fit.py::test_every_rung_is_what_its_effects_are_as_a_model":
        "a rung starts from the larger model's values and ends within rounding of another fit",
    "tests/estimation/test_diagnosis.py::"
    "test_a_formula_for_the_unexplained_is_a_suggestion_that_can_be_pasted_into_a_model_file":
        "the errors of the pasted file differ from those promised by 1 %",
    "tests/estimation/test_diagnosis_search.py::"
    "test_a_dead_time_and_a_limited_torque_take_the_place_of_a_lag_and_a_ramp":
        "a lag and a limited acceleration are named for a dead time and a limited torque",
    "tests/estimation/test_drive_answers.py::"
    "test_it_is_named_with_its_numbers_and_nothing_beside_it[body_acceleration_limit]":
        "without poses, jumps between two readings of the encoders are taken for a limit of each wheel, too",
    "tests/estimation/test_joint_clocks.py::"
    "test_the_clock_of_each_run_is_told_and_no_effect_stands_for_it[the command alone]":
        "the clock of one of three runs lies 2.5 standard errors off: .0580 for .06 s",
}  # fmt: skip
