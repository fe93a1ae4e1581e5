from .page import INDEX as INDEX
from .page import SUBMISSIONS as SUBMISSIONS
from .page import page_files as page_files
from .page import write_page as write_page
