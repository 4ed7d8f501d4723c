"""Recordings in, MCAP out: what a recording holds, its topics as columns, transforms, and writing.

Reading is columnar and as fast as inflating the chunks; what is damaged is told, what is whole around it is
read. Nothing here knows what the numbers mean.
"""

from pipeline.logs.bags import ROS1_BAG, SQLITE_BAG
from pipeline.logs.buckets import FETCHED, open_store
from pipeline.logs.budget import OVER_BUDGET
from pipeline.logs.columns import Ragged, RaggedStrings, Strings
from pipeline.logs.definitions import bundled_types, definition_text, field_names
from pipeline.logs.errors import LogError, Loss
from pipeline.logs.index import SUFFIXES, ChannelInfo, LogIndex, hash_log, list_files, open_log, shorten
from pipeline.logs.join import join_channels
from pipeline.logs.part import is_finished
from pipeline.logs.reader import LogData, TopicColumns, Wanted, read_topics
from pipeline.logs.remote import RemotePath, locate_recorded, spell_location, to_location
from pipeline.logs.transforms import TransformBuffer, TransformSeries, wanted_transforms
from pipeline.logs.writer import LogWriter
