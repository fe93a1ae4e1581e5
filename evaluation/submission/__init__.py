"""Submissions: ``submission.yaml`` and the prediction files beside it, in every accepted form."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
