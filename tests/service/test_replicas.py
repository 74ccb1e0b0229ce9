"""Two coordinators, real processes, on one database and one storage: one is killed, the other goes on; both stop in order."""

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx
import pytest

from kiln_service.auth import OWNER_VARIABLE

TOKEN = "the-same-at-every-coordinator"
TIMING = {"heartbeat_s": 0.2, "stale_s": 2, "poll_s": 0.1, "maintenance_s": 0.2}
LEADER = """
    SELECT activity.application_name AS name FROM pg_locks
    JOIN pg_stat_activity AS activity USING (pid)
    WHERE locktype = 'advisory' AND classid = 27497 AND objid = 1819148290 AND granted
"""
