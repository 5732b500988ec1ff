"""One short simulated recording, written in the raw files of each published data set.

`recording.simulated()` makes it once per test run; the other modules write it as their data set is downloaded.
"""
