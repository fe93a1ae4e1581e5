from .exports import FORMS as FORMS
from .exports import export_capture as export_capture
from .exports import pixel_normals as pixel_normals
from .exports import triangles as triangles
from .images import COLOURS as COLOURS
from .images import CapturedFrames as CapturedFrames
from .images import frame_files as frame_files
from .images import read_frames as read_frames
