"""Reading of recordings (index, topics as columns, transforms) and writing of MCAP files.

Reading is columnar and as fast as inflating the chunks. Damage is reported as losses, and the undamaged data
around it are read. The package does not interpret the values of messages.
"""

from pipeline.logs.bags import ROS1_BAG, SQLITE_BAG
from pipeline.logs.catalog import OVER_BUDGET
from pipeline.logs.columns import Ragged, RaggedStrings, Strings
from pipeline.logs.growing import GrowingLog
from pipeline.logs.index import SUFFIXES, ChannelInfo, LogIndex, hash_log, list_files, open_log, shorten
from pipeline.logs.part import is_finished
from pipeline.logs.reader import LogData, TopicColumns, Wanted, join_channels, read_topics
from pipeline.logs.records import LogError, Loss
from pipeline.logs.remote import FETCHED, RemotePath, locate_recorded, open_store, spell_location, to_location
from pipeline.logs.schema import bundled_types, definition_text, field_names
from pipeline.logs.transforms import TransformBuffer, TransformSeries, wanted_transforms
from pipeline.logs.writer import LogWriter
