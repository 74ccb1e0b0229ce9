"""Claiming tasks, running them in a child process, and handing back what they made."""
