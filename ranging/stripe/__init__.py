"""ranging.stripe."""

from ranging.stripe._peak_kernels import Pixels
from ranging.stripe.channel import best_channel
from ranging.stripe.extraction import Along, Method, Stripe, StripeOptions, Which, extract, find_along

__all__ = ["Along", "Method", "Pixels", "Stripe", "StripeOptions", "Which", "best_channel", "extract", "find_along"]
