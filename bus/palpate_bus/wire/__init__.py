"""rmw_zenoh's wire format on zenoh: keys, attachments, liveliness tokens, transports."""
