"""The dataset format on disk: Arrow shards, manifest, reading, verifying, Parquet."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
