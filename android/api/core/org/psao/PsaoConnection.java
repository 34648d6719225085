package org.psao;

import java.nio.ByteBuffer;
import java.nio.charset.Charset;

/**
 * A connection to a server over QUIC: a transport, if you have none. It takes memory as it needs
 * it, and has one native thread until it is closed. Only where the native library was built with
 * the feature {@code quic}.
 *
 * <p>Threads: any, one at a time; others wait, for less than a frame but while it opens or closes.
 */
public final class PsaoConnection implements AutoCloseable {
    private final Words words = new Words(2);
    private long connection;

    /**
     * Connects, and sends the hello: what {@link PsaoUplink#hello} would write. Waits until the
     * server has proved who it is, or 5 s if nothing answers: not for the thread that draws. Makes
     * garbage.
     *
     * @param address {@code host:port}; an IPv6 address in brackets
     * @param serverName the name in the server's certificate; null: the host of address
     * @param token the token that the server was started with; null: none
     * @param fingerprint the server has exactly the certificate with this SHA-256, 64 hexadecimal
     *     digits: what it prints when it starts; null: rootsPem says who is trusted
     * @param rootsPem certificates in PEM, one of which signed the server's; null if there is a
     *     fingerprint
     * @param topologyHash of {@link PsaoClient#topologyHash}; 0 for a new client
     * @param config the client's
     * @throws PsaoException {@link PsaoResult#ERROR_VALUE}: a string is not what it should be, or
     *     there is not exactly one of fingerprint and rootsPem.
     *     {@link PsaoResult#ERROR_UNTRUSTED}, {@link PsaoResult#ERROR_NO_CONNECTION}
     * @throws IllegalStateException if the native library has no QUIC
     */
    public PsaoConnection(
            String address, String serverName, String token, String fingerprint, String rootsPem,
            long topologyHash, PsaoConfig config) {
        // Native loads the library, and checks it.
        Native.version();
        String text;
        try {
            text = NativeConnection.open(
                    utf8(address), utf8(serverName), utf8(token), utf8(fingerprint),
                    utf8(rootsPem), topologyHash, config.words(), words.address, words);
        } catch (UnsatisfiedLinkError error) {
            throw new IllegalStateException(
                    "psao_jni has no connections: build it with --features quic", error);
        }
        if (words.get(0) < 0) {
            throw new PsaoException((int) words.get(0), text);
        }
        connection = words.get(1);
    }

    /**
     * Takes bytes of the stream that have come, for {@link PsaoClient#push}, and writes them
     * between the buffer's position and its limit. The position is then behind them. Never waits.
     * What is not taken stays, up to 1 MiB; beyond that the server is asked to wait, and merges
     * what changes meanwhile.
     *
     * @param out room for what came
     * @return how many bytes; 0: none have come since
     * @throws PsaoException {@link PsaoResult#ERROR_CLOSED}: none will come any more, and all that
     *     came was taken; the message says why
     * @throws IllegalStateException if it was closed here
     */
    public synchronized int receive(PsaoBuffer out) {
        checkOpen();
        ByteBuffer bytes = out.bytes();
        int from = bytes.position();
        int room = Math.max(0, bytes.limit() - from);
        int came = NativeConnection.receive(connection, out.address + from, room, out);
        if (came == PsaoResult.ERROR_CLOSED) {
            String text = NativeConnection.closedText(connection, words.address, words);
            throw new PsaoException(came, text);
        }
        bytes.position(from + PsaoException.check(came));
        return came;
    }

    /**
     * Sends a message that {@link PsaoUplink} wrote, but for the hello, which was sent: the bytes
     * between the buffer's position and its limit. Its number does not matter: the connection
     * counts anew. Cameras and acknowledgements overtake older ones; all else arrives surely and
     * in order. Never waits.
     *
     * @param message one whole message; the position is then behind it
     * @throws PsaoException {@link PsaoResult#ERROR_VALUE}: it is no such message.
     *     {@link PsaoResult#ERROR_BUSY}: the network is slower than the messages: send the newest
     *     state again later. {@link PsaoResult#ERROR_CLOSED}: see {@link #receive}
     * @throws IllegalStateException if it was closed here
     */
    public synchronized void send(PsaoBuffer message) {
        checkOpen();
        ByteBuffer bytes = message.bytes();
        int from = bytes.position();
        int length = Math.max(0, bytes.limit() - from);
        PsaoException.check(
                NativeConnection.send(connection, message.address + from, length, message));
        bytes.position(from + length);
    }

    /**
     * Closes the connection, tells the server, ends its thread and frees its memory. Waits at most
     * 1 s. Doing it again does nothing.
     */
    @Override
    public synchronized void close() {
        if (connection != 0) {
            NativeConnection.close(connection);
            connection = 0;
        }
    }

    private void checkOpen() {
        if (connection == 0) {
            throw new IllegalStateException("the connection is closed: make a new one");
        }
    }

    private static byte[] utf8(String text) {
        return text == null ? null : text.getBytes(Charset.forName("UTF-8"));
    }
}
