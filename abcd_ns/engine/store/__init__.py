"""Where blocks are kept, with all that training goes on from."""

from abcd_ns.engine.store.atomic import FolderLockedError as FolderLockedError
from abcd_ns.engine.store.parameter_store import ParameterStore as ParameterStore
from abcd_ns.engine.store.parameter_store import StoreError as StoreError
