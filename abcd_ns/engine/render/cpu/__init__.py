"""The rasterizer in plain torch, tile by tile; inner loops run as machine code where a compiler is found."""
