from .method import ClassicalNetMethod as ClassicalNetMethod
from .network import DepthFilter as DepthFilter
from .scene import CHANNELS as CHANNELS
from .scene import DepthScene as DepthScene
from .training import FilterRecipe as FilterRecipe
from .training import train_classical_net as train_classical_net
