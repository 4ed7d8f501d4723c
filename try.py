"""Try: all drive candidates of a log against its chosen pose."""
import sys, time, warnings
from pathlib import Path
import numpy as np
from dataclasses import replace
from pipeline.job.keys import *
from pipeline.job import log_choice as lc
from pipeline.job import Options
from pipeline.sources import *
from pipeline.sources.candidates import *
from pipeline.sources.configuration import DriveSection, Vehicle
from pipeline.stages.extract import _Extraction
from pipeline.stages.reading import list_wanted
from pipeline.logs import open_log, read_topics
from pipeline.core import SlipError
from pipeline.recording.motion import measure_motion
from pipeline.recording.readings import *
UNIT = dict(id="u", name="u", wheel_radius_m=1.0, track_width_m=1.0, wheelbase_m=1.0)
def candidates(types, robot=None):
    t = Topics(types); out = {}
    for commanded in (True, False):
        for steered in (False, True):
            for rank, d in t.list_drives(commanded=commanded, steered=steered):
                out.setdefault((d.form, d.signals), (rank, commanded, d))
    return list(out.values())
def run(path):
    path = Path(path); index = open_log(path)
    conf = load_configuration(path)
    veh = lc.make_stand_in(index, conf); veh = replace_(veh)
    try: src = choose_sources(index.channels, conf, veh, where=str(path))
    except SlipError as e: print(path.name, 'REFUSED', e.what); return
    if src.pose is None: print(path.name, 'NO POSE'); return
    types = {c.topic: c.type_name for c in index.channels if c.message_count != 0}
    from pipeline.sources.message_types import plain_type
    cand = candidates({k: plain_type(v) for k, v in types.items()})
    rivals = [p for p in src.others.get('pose', ()) if isinstance(p, PoseSource)]
    data = read_topics(index, list_wanted(src, index.types, [*rivals, *(d for _, _, d in cand)]))
    from pipeline.stages.pose_choice import rate_poses, replace_pose
    if rivals:
        r = rate_poses(data, src, conf, veh, where=str(path)); src = replace_pose(src, r)
    t0 = time.process_time()
    ex = _Extraction(data, replace(src, command=None, wheels=None), conf, veh, str(path))
    m = measure_motion(ex._poses())
    if m is None: print(path.name, 'NO MOTION'); return
    c, k = m.find_course_deg()
    print(f'{path.name}: pose {src.pose} {m.rate_hz:.1f} Hz up {m.up} course {c:.0f} ({k:.2f}) n {m.moved.size} odd {m.odd}; today: {src.command} | {src.wheels}')
    imu = ex._imu()
    reads = []
    for rank, commanded, d in cand:
        steer = d.form is DriveForm.STEERING
        ex.vehicle = Vehicle(kind='ackermann' if steer else 'differential', **UNIT)
        try: tab = ex._drive_table(d, DriveSection(), held=True)
        except SlipError as e: print('   unreadable', d, e.what); continue
        tt = tab['t'].to_numpy(); col = lambda n: tab[n].cast(float).fill_null(np.nan).to_numpy()
        if d.form is DriveForm.BODY: rd = Reading('body', str(d), Held(tt, col('body_x')), Held(tt, col('body_w')))
        elif steer:
            v = Held(tt, col('speed')); rd = Reading('steering', str(d), v, Bent(v, tt, col('steering')) if v.moves else None)
        else: rd = Reading('sides', str(d), Held(tt, col('left')), Held(tt, col('right')))
        rd.note = ('C' if commanded else 'W') + f'{rank:.1f}'
        reads.append(rd)
    if imu.height: reads.append(Reading('gyro', str(src.imu), None, Held(imu['t'].to_numpy(), imu['rate_z'].to_numpy()))); reads[-1].note = ''
    for rd in reads:
        e = rd.explain(m)
        if e is None: print('   nothing  ', rd.form, rd.name); continue
        held = np.mean([i.held_share for i in rd.inputs])
        print(f'   {rd.note:4} {rd.form:8}{rd.name[:60]:60} moves z {e.moves:5.1f} nats {e.nats:5.2f} ahead {e.ahead.gains[0]:8.4g} t {e.ahead.t[0]:6.1f} turned {e.turned.gains[0]:8.4g} t {e.turned.t[0]:6.1f} lag {e.lag:.2f}{e.delay:+.2f} crossed {e.crossed} ({e.sign_margin:.1f}) lead {e.lead:.1f} held {held:.2f}')
    print(f'   cpu {time.process_time()-t0:.2f}')
def replace_(v): return v
for p in sys.argv[1:]:
    try: run(p)
    except Exception as e: print(p, 'ERROR', repr(e)[:300])
