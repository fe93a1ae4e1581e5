"""An object's views put together: one point cloud from their depth maps, and the pixels that other views contradict."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
