"""The raster engine for graphics cards: shaders in OpenGL.

Its engine is loaded when it draws, as an attribute of this package: without a card nothing of OpenGL is loaded.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, submodules=["engine"])
