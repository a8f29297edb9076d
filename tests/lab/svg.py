"""Charts, as tests read them."""

import xml.etree.ElementTree as ET
from pathlib import Path


def texts_of(svg: Path) -> list[str]:
    """What stands in a chart, piece by piece."""
    return ["".join(node.itertext()) for node in ET.parse(svg).iter("{http://www.w3.org/2000/svg}text")]
