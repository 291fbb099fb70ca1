"""What a person looks at: messages become a Rerun recording. The only room that knows Rerun."""

from companion.viewer.sinks import FileViewer, LiveViewer

__all__ = ["FileViewer", "LiveViewer"]
