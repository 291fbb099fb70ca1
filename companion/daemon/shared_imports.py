"""Imports that the daemon and its stages have in common, or two stages or more.

Made before the fork server is copied off: their pages are then shared, and no stage waits for them.
"""

import concurrent.futures  # noqa: F401
import csv  # noqa: F401
import hashlib  # noqa: F401
import importlib.metadata
import importlib.resources  # noqa: F401
import logging  # noqa: F401
import sqlite3  # noqa: F401
import zipfile  # noqa: F401

import companion.geometry.pose_table
import companion.products.versions
import companion.streaming.scene_encoder  # noqa: F401
import drivers.mavlink.wire.packet_stream
import drivers.recording.flights_folder
import drivers.system.file_pages  # noqa: F401
