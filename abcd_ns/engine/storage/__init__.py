"""Where blocks and layers are kept: the store is precious, the layer cache is disposable."""

from abcd_ns.engine.storage.atomic import FolderLockedError as FolderLockedError
from abcd_ns.engine.storage.layer_cache import LayerCache as LayerCache
from abcd_ns.engine.storage.layer_cache import LayerKey as LayerKey
from abcd_ns.engine.storage.layer_cache import StaleLayerError as StaleLayerError
from abcd_ns.engine.storage.layer_cache import view_fingerprint as view_fingerprint
from abcd_ns.engine.storage.layer_codec import LayerDecodeError as LayerDecodeError
from abcd_ns.engine.storage.layer_codec import through_codec as through_codec
from abcd_ns.engine.storage.parameter_store import ParameterStore as ParameterStore
from abcd_ns.engine.storage.parameter_store import StoreError as StoreError
