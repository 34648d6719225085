package org.psao;

/** The native methods of a library that was built with the feature {@code quic}. */
final class NativeConnection {
    private NativeConnection() {}

    static native String open(
            byte[] address, byte[] serverName, byte[] token, byte[] fingerprint, byte[] rootsPem,
            long topologyHash, long[] config, long words, Object keep);

    static native int receive(long connection, long out, int capacityBytes, Object keep);

    static native String closedText(long connection, long words, Object keep);

    static native int send(long connection, long message, int messageBytes, Object keep);

    static native void close(long connection);
}
