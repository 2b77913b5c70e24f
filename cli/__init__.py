"""argv to the library to print to exit status; no mathematics.

In: the words of a command line.
Out: tables or `--json` on stdout, talk on stderr, exit status 0, 1, 2 or 3.
Read: main, live, console, calibrate, scan, measure, locate, robot, merge, inspection, view, target, design, batch, certificate.
"""
