"""ABCD's reader of data, for any method of nerfstudio's: `ns-train splatfacto --data DIR abcd-data`.

nerfstudio loads this while it is itself half loaded, and for each of its commands: see `abcd_ns.methods`.
"""

import sys
import warnings

from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from abcd_ns.errors import IMPORT_TROUBLE, UserError, missing
from abcd_ns.nerfstudio.flags import opens_ours, trains_ours

if trains_ours(sys.argv) or opens_ours(sys.argv):
    # What nerfstudio 1.1.5 calls is still there under these names. It is called when modules are loaded that
    # come after this one, so later would be too late; other commands' warnings are not ours to hide.
    warnings.filterwarnings("ignore", r"`torch\.cuda\.amp\.", FutureWarning)

try:
    from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
except IMPORT_TROUBLE as error:
    _trouble = missing(error)

    def _refuse(_config: DataParserConfig) -> None:
        raise UserError(_trouble)

    _config = DataParserConfig(_target=_refuse)
else:
    _config = AbcdDataParserConfig(as_stored=True)

abcd_data = DataParserSpecification(
    _config, "COLMAP models and transforms.json, checked before anything is trained."
)
