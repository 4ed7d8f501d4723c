"""The contract of every table: columns, types, units, frames and rules.

A table is a subclass of `Table` with a ``VERSION``, called as the class; it is found by being in this
folder. Units and frames stand in the columns' metadata and reach the Parquet files from there.
"""

from schemas.contract import Contract, Table, contract_of, list_contracts
