"""FPP-C: which disturbance breaks a method, axis by axis. A disturbance changes one stage of the
image formation. A pixel without an answer is charged a fixed error."""
