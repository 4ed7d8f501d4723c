"""Foundations of all rooms: errors, texts, kinds of arrays, rigid motions, time grids, processes.

An error has a stable code for scripts, states what is wrong and where, and ends with what to do about it.
Each room derives a class of its own.
"""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.core.arrays import (
        PAUSE_NS,
        PERIODS,
        ROUNDING_S,
        SILENT_S,
        STRETCH_S,
        Complex,
        Flags,
        Floats,
        Ints,
        fit_robustly,
        group_rows,
        guarded_spread,
        interpolate_linearly,
        jackknife_deviation,
        join_parts,
        nearest_indices,
        number_stretches,
        recur,
        robust_spread,
        robust_spreads,
        spread_equal,
        student_quantile,
        turn_units,
    )
    from pipeline.core.compute import (
        Budget,
        Newest,
        map_in_order,
        return_freed_memory,
        usable_threads,
        usual_budget,
    )
    from pipeline.core.levels import (
        CONFIDENCE,
        FEWEST_OF_SPREAD,
        FOLDS,
        JSON_DIGITS,
        NORMAL_95,
        finite_or_none,
        pick,
        pick_finite,
        round_digits,
    )
    from pipeline.core.machine_code import (
        LANES,
        compile_loops,
        compiled,
        deal_lanes,
        list_caches,
        require_compiler,
    )
    from pipeline.core.memory import MemoryWatchdog, limit_memory, measure_memory, read_memory
    from pipeline.core.processes import (
        PACKAGE,
        THREAD_VARIABLES,
        end_with,
        keep_current_folder_out,
        python_command,
        read_version,
        require_package,
        silence_warnings,
        slip_command,
    )
    from pipeline.core.rigid import (
        GRAVITY_MPS2,
        LONGEST_WAIT_S,
        euler_from_quaternions,
        find_held,
        find_runs,
        interpolate_poses,
        invert_quaternions,
        measure_increments,
        multiply_quaternions,
        quaternions_from_euler,
        quaternions_from_vectors,
        quaternions_from_yaw,
        rotate,
        rotation_vectors,
    )
    from pipeline.core.student import LOG_PEAK, find_scale, list_likelihoods, weigh
    from pipeline.core.text import (
        FIGURES,
        INPUT_WORDS,
        INPUTS,
        TREND_THRESHOLD,
        FigureFormat,
        SlipError,
        align_rows,
        count_places,
        enumerate_texts,
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
        guess_names,
        make_plain,
        mark_finding,
        name_first,
        naming_os_errors,
        shorten,
        split_interval,
        suffix_unit,
    )
    from pipeline.core.untrusted import (
        MOST_BYTES,
        TOO_LARGE,
        PathError,
        TomlError,
        format_csv,
        mapping_in,
        may_lead_out,
        number_in,
        numbers_in,
        objects_in,
        parse_toml,
        read_bounded,
        read_bounded_text,
        read_object,
        require_finite,
        resolve_inside,
        too_large,
        walk_files,
        walk_tree,
    )
else:
    __getattr__ = open_door(__name__, __file__)
