"""The whole path on a simulated rig, each result beside the truth.

In: nothing.
Out: a folder with rig, cloud, pages and figures.
Read: run, precompile.
"""

from scope.demo.run import demo_text, run_demo

__all__ = ["demo_text", "run_demo"]
