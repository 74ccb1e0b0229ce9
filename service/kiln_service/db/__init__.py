"""The database: named queries in .sql files, migrations, and one thin layer over psycopg to run them."""

from kiln_service.db.database import Database, Tx, execute, fetched
from kiln_service.db.lenient import readable, readable_problem, readable_rows
from kiln_service.db.rows import JobRow, TaskRow, WorkerRow, job_rows, picked

__all__ = [
    "Database",
    "JobRow",
    "TaskRow",
    "Tx",
    "WorkerRow",
    "execute",
    "fetched",
    "job_rows",
    "picked",
    "readable",
    "readable_problem",
    "readable_rows",
]
