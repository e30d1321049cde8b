"""The paper's loop and the folder it writes: fit, information, choose, capture."""
