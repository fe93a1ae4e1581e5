"""Submissions: ``submission.yaml`` and the prediction files beside it, in every accepted form."""
