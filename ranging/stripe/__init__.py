"""A stripe image to sub-pixel positions, one a row or column, each with its own sigma.

In: the laser's light (H, W) as the camera's noise model knows it.
Out: `Stripe`: position, sigma, width, peak of every line, NaN with a `Reason` where there is none.
Read: extraction, channel.
"""

from ranging.stripe._table import Lines
from ranging.stripe.channel import best_channel
from ranging.stripe.extraction import Along, Stripe, StripeOptions, extract, find_along

__all__ = ["Along", "Lines", "Stripe", "StripeOptions", "best_channel", "extract", "find_along"]
