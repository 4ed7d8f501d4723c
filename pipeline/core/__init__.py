"""Foundations of all rooms: errors, texts, kinds of arrays, rigid motions, time grids, processes.

An error has a stable code for scripts, states what is wrong and where, and ends with what to do about it.
Each room derives a class of its own.
"""

from typing import TYPE_CHECKING

from pipeline.core.compute import (
    Budget,
    Newest,
    map_in_order,
    return_freed_memory,
    usable_threads,
)
from pipeline.core.memory import limit_memory, measure_memory, read_memory
from pipeline.core.processes import (
    PACKAGE,
    end_with,
    keep_current_folder_out,
    prepare_workers,
    python_command,
    read_version,
    require_package,
    silence_warnings,
)
from pipeline.core.text import (
    CONFIDENCE,
    FEWEST_OF_SPREAD,
    FIGURES,
    FOLDS,
    INPUT_WORDS,
    INPUTS,
    JSON_DIGITS,
    LONGEST_NAME,
    LONGEST_TEXT,
    NORMAL_95,
    FigureFormat,
    SlipError,
    align_rows,
    count_places,
    enumerate_texts,
    finite_or_none,
    format_angle,
    format_count,
    format_digits,
    format_duration,
    format_errors,
    format_interval,
    format_length,
    format_part,
    format_recorded,
    format_share,
    format_size,
    format_two,
    group_by,
    guess_names,
    make_plain,
    mark_finding,
    name_first,
    naming_os_errors,
    pick,
    pick_finite,
    round_digits,
    shorten,
    split_interval,
    suffix_unit,
)
from pipeline.core.untrusted import (
    MOST_BYTES,
    PathError,
    TomlError,
    TooLargeError,
    format_csv,
    mapping_in,
    may_lead_out,
    number_in,
    numbers_in,
    objects_in,
    parse_toml,
    quote_formulas,
    read_bounded,
    read_bounded_text,
    read_object,
    require_finite,
    resolve_inside,
    walk_files,
    walk_tree,
)
from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.core.arrays import *
    from pipeline.core.machine_code import *
    from pipeline.core.rigid import *
else:
    __getattr__ = open_door(
        __name__,
        {
            "arrays": (
                "LOG_PEAK",
                "PAUSE_NS",
                "PERIODS",
                "ROUNDING_S",
                "SILENT_S",
                "STRETCH_S",
                "Complex",
                "Flags",
                "Floats",
                "Ints",
                "find_scale",
                "fit_robustly",
                "group_rows",
                "guarded_spread",
                "interpolate_linearly",
                "jackknife_deviation",
                "join_parts",
                "list_likelihoods",
                "nearest_indices",
                "number_stretches",
                "recur",
                "robust_spread",
                "robust_spreads",
                "spread_equal",
                "student_quantile",
                "turn_units",
                "weigh",
            ),
            "machine_code": (
                "LANES",
                "compile_loops",
                "compiled",
                "deal_lanes",
                "list_caches",
                "require_compiler",
            ),
            "rigid": (
                "GRAVITY_MPS2",
                "LONGEST_WAIT_S",
                "euler_from_quaternions",
                "find_held",
                "find_runs",
                "interpolate_poses",
                "invert_quaternions",
                "measure_increments",
                "multiply_quaternions",
                "quaternions_from_euler",
                "quaternions_from_vectors",
                "quaternions_from_yaw",
                "rotate",
                "rotation_vectors",
            ),
        },
    )
