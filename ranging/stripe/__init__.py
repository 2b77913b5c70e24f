"""ranging.stripe."""

from ranging.stripe._peak_kernels import Pixels
from ranging.stripe.extraction import Along, Stripe, StripeOptions, extract, find_along

__all__ = ["Along", "Pixels", "Stripe", "StripeOptions", "extract", "find_along"]
