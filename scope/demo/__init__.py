"""scope.demo."""

from scope.demo.run import demo_text, run_demo

__all__ = ["demo_text", "run_demo"]
