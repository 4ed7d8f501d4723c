"""From the MCAP logs of field robots to knowledge about their motion. In Python: ``import slip``."""
