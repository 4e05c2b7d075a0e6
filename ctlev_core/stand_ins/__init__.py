"""Random weights and made-up recordings, in the place of those that must be downloaded: for rehearsals of a plan.

They have the sizes, file layouts and sensors of what they stand in for, and nothing can be learnt from them.
"""
