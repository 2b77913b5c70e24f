"""A stripe image to points: background, stripe, triangulation, motion, and the uncertainty of every point.

In: an image, the camera's rays and the sheet of light.
Out: points (N, 3) in mm, one a line of the image, each with sigma, sigma_cal and, where there is none, a
    `Reason`.
Read: background, the room stripe, triangulation, covariance, profile, motion, robot, the room surface, errors.
"""
