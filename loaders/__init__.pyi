from .storage.joined import load_dataset as load_dataset
from .storage.store import DatasetFolder as DatasetFolder
from .training import FringeDepthDataset as FringeDepthDataset
