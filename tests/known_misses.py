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
    "tests/estimation/test_diagnosis.py::"
    "test_motion_that_lasts_is_unexplained_and_its_own_past_predicts_it":
        "what lasts is told for sideways motion (.53 of it), and not for turning",
    "tests/estimation/test_diagnosis_recordings.py::"
    "test_what_is_named_is_what_a_vehicle_can_do[command-warthog_wheels_ice_2024_7_30_16h30s21]":
        "the track factor of the Warthog on ice is 1.495, below 1.5",
    "tests/estimation/test_diagnosis_recordings.py::"
    "test_what_is_named_is_what_a_vehicle_can_do[measured-warthog_wheels_ice_2024_7_30_16h30s21]":
        "the track factor of the Warthog on ice is 1.495, below 1.5",
    "tests/estimation/test_diagnosis_recordings.py::"
    "test_on_ice_what_is_left_is_no_structure[command]":
        "a formula for 13 % of the yaw error is suggested",
    "tests/estimation/test_diagnosis_recordings.py::"
    "test_on_ice_what_is_left_is_no_structure[measured]":
        "a formula for 13 % of the yaw error is suggested",
    "tests/estimation/test_diagnosis_recordings.py::"
    "test_the_servo_of_the_warthog_explains_its_turning":
        "its wheel speed limit is not named beside the servo",
    "tests/estimation/test_diagnosis_recordings.py::"
    "test_the_left_motor_of_the_warthog_is_weaker":
        "with all effects .092 rad remain, and .08 did before",
    "tests/estimation/test_floor.py::"
    "test_the_floor_is_what_the_true_model_leaves_of_unseen_data[lasting-1-40.0]":
        "the floor of heading is .69 of what the true model leaves, .7 is asked",
    "tests/estimation/test_poor_driving.py::"
    "test_a_change_of_ground_on_a_straight_is_a_change_of_speed":
        "it is named time_drift",
    "tests/estimation/test_suggestions.py::"
    "test_the_written_model_has_no_formula_and_no_effect_that_raises_its_errors[published/optiodom_tricycle/tri_free_140120211525_1]":
        "the last effect raises both errors a little",
    "tests/models/test_contact_friction.py::"
    "test_friction_comes_back_from_every_start[0.7]":
        "from one start the fit ends at .63",
    "tests/models/test_motion_incidents.py::"
    "test_95_of_100_incidents_are_found_within_a_second_at_both_ends":
        "59 of 60 are found, and 6 that are none, 4 are allowed",
    "tests/models/test_wheel_servo.py::"
    "test_what_comes_out_changes_steadily_with_every_number":
        "a jump of .002 m/s by its delay",
    "tests/hidden/test_published.py::"
    "test_an_effect_that_undoes_another_is_not_named_and_no_formula_hides_the_offset":
        "the offset is -.01709 rad, -.0201 +- .003 was published",
    "tests/estimation/test_one_answer.py::test_every_verb_file_and_page_says_the_same_of_a_recording"
    "[warthog_gravel_1-Input.MEASURED]":
        "a second fit of its model ends .1 to .2 half widths off, its errors 1 %",
    "tests/estimation/test_one_answer.py::test_every_verb_file_and_page_says_the_same_of_a_recording"
    "[warthog_wheels_asphalt_2024_8_7_11h30s30-Input.COMMAND]":
        "a second fit of its model ends .1 to .2 half widths off, its errors 1 %",
    "tests/estimation/test_one_answer.py::test_every_verb_file_and_page_says_the_same_of_a_recording"
    "[warthog_wheels_grass_2024_8_8_16h19s23-Input.COMMAND]":
        "a second fit of its model ends .1 to .2 half widths off, its errors 1 %",
    "tests/estimation/test_one_answer.py::test_every_verb_file_and_page_says_the_same_of_a_recording"
    "[warthog_wheels_ice_2024_7_30_16h30s21-Input.COMMAND]":
        "a second fit of its model ends .1 to .2 half widths off, its errors 1 %",
    "tests/estimation/test_one_answer.py::test_every_verb_file_and_page_says_the_same_of_a_recording"
    "[warthog_wheels_ice_2024_7_30_16h30s21-Input.MEASURED]":
        "a second fit of its model ends .1 to .2 half widths off, its errors 1 %",
    "tests/estimation/test_one_answer.py::test_every_verb_file_and_page_says_the_same_of_a_recording"
    "[warthog_wheels_sand_2024_9_25_14h32s32-Input.COMMAND]":
        "a second fit of its model ends .1 to .2 half widths off, its errors 1 %",
}  # fmt: skip
