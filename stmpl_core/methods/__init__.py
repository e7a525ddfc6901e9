"""One file a method; all follow the protocol in base."""
