"""The pipeline as torch operations on one device: what a GPU runs in place of the numpy one.

Files here mirror those of the same name one folder up, stage by stage, with tensors for arrays.
"""
