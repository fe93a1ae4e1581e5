from .api import compare as compare
from .api import decode as decode
from .api import evaluate as evaluate
from .api import load_dataset as load_dataset
from .api import load_method as load_method
from .api import open_dataset as open_dataset
from .api import rank as rank
from .baselines.method import Method as Method

__version__: str
