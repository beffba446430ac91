"""Messages on zenoh as rmw_zenoh has them: keys, attachments, liveliness tokens, transports."""
