"""What a person looks at: messages become a Rerun recording. The only room that knows Rerun."""

from companion.viewer.file_viewer import FileViewer
from companion.viewer.live_viewer import LiveViewer

__all__ = ["FileViewer", "LiveViewer"]
