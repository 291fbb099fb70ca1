"""What a person looks at: a flight becomes a Rerun recording. The only room that knows Rerun."""

from companion.stream.story import Watched
from companion.viewer.colours import Colours
from companion.viewer.file_viewer import FileViewer
from companion.viewer.ground import show
from companion.viewer.live_viewer import LiveViewer
from companion.viewer.screen import Screen

__all__ = ["Colours", "FileViewer", "LiveViewer", "Screen", "Watched", "show"]
