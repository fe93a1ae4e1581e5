from .captures import BOARD_FILE as BOARD_FILE
from .captures import board_frames as board_frames
from .captures import photograph_board as photograph_board
from .poses import BOARD_POSES as BOARD_POSES
from .poses import PAPER_BOARD as PAPER_BOARD
from .poses import BoardPose as BoardPose
from .poses import board_poses as board_poses
from .poses import fitting_board as fitting_board
