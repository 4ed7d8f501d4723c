"""A run as arrays for models, diagnosis and pages: commands, wheels, poses, gyro, stretches to compare."""

from typing import TYPE_CHECKING

from pipeline.door import open_door

if TYPE_CHECKING:
    from pipeline.run.heading import (
        Grid,
        HeadingSource,
        HeldDrive,
        MeasuredDrive,
        align_heading,
        choose_heading,
        find_silences,
        fit_gyro,
        fit_turning,
        has_excluded,
        lay_grid,
        mark_excluded,
    )
    from pipeline.run.motion_run import (
        TABLE_COLUMNS,
        Alignment,
        GyroFit,
        MotionError,
        MotionRun,
        Track,
        load_motion_run,
        load_run,
        make_motion_run,
        make_run,
        read_alignment,
        read_drive,
        read_wheel_times,
        select_fresh,
        tabulate_alignment,
    )
    from pipeline.run.signals import (
        ANSWERS_S,
        GROUND_UNOBSERVABLE,
        HORIZON_S,
        LEAST_RIM_SPEED,
        LIVE_SHARE,
        MOVING_MPS,
        SPAN_S,
        STILL_MPS,
        Commands,
        DriveSeries,
        Floats,
        Limits,
        Resets,
        Rolling,
        RunContext,
        Signal,
        Velocity,
        Wheels,
        change_wheels,
        earlier_in_span,
        find_fastest_wheel,
        find_limits,
        find_turning,
        name_inputs,
        roll_ideally,
        split_wheels,
        trace_traction,
    )
    from pipeline.run.windows import (
        NODE_S,
        Windows,
        average_spans,
        cut_run,
        find_driven,
        find_gaps,
        find_lead,
        gather_nodes,
        join_horizons,
        join_steps,
        join_windows,
    )
else:
    __getattr__ = open_door(__name__, __file__)
