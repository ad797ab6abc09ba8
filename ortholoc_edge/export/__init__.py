"""Makes the graphs of `matching.exported` from published weights. Needs the extra ``[export]`` (PyTorch); nothing that
flies imports it."""
