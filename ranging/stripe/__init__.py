"""ranging.stripe."""

from ranging.stripe._peak_kernels import Pixels
from ranging.stripe.channel import best_channel
from ranging.stripe.extraction import Along, Stripe, StripeOptions, extract, find_along

__all__ = ["Along", "Pixels", "Stripe", "StripeOptions", "best_channel", "extract", "find_along"]
