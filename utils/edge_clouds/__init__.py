"""Semi-dense clouds from event edges: depths borrowed from tracked patches, and the same refined by focus."""
