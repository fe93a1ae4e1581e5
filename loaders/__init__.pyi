from . import hub as hub
from . import hub_dataset as hub_dataset
from .storage.store import DatasetFolder as DatasetFolder
from .storage.store import load_dataset as load_dataset
from .training import FringeDepthDataset as FringeDepthDataset
