"""Viewer: a flight as a Rerun recording. The only package that knows Rerun."""

import os

# before rerun loads: that recordings have no list of their chunks is meant, see rrd_files; that a
# viewer went before the last was sent to it, as where Ctrl-C ends both, is no fault
os.environ.setdefault(
    "RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error,re_sdk::recording_stream=off"
)

from companion.streaming.scene_encoder import Watched
from companion.streaming.viewer.colours import Colours
from companion.streaming.viewer.file_viewer import FileViewer
from companion.streaming.viewer.ground_viewer import show
from companion.streaming.viewer.screen import Screen

__all__ = ["Colours", "FileViewer", "Screen", "Watched", "show"]
