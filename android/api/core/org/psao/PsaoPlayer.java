package org.psao;

import java.io.IOException;
import java.io.InputStream;

/**
 * Plays a recording to a client, at the pace at which it was recorded: the pusher's part, for a
 * thread of yours. While it is paused nothing moves, and nothing runs.
 *
 * <pre>
 * PsaoPlayer player = new PsaoPlayer(client, new FileInputStream("street.psao"));
 * new Thread(player, "psao").start();
 * </pre>
 *
 * <p>Threads: {@link #run} once, on the pusher's thread; all else from any.
 */
public final class PsaoPlayer implements Runnable, AutoCloseable {
    private static final int PIECE_BYTES = 1 << 16;
    private static final long NS_PER_MS = 1000000;

    private final PsaoClient client;
    private final InputStream recording;
    private final Object lock = new Object();
    private boolean paused;
    private boolean closed;
    /** How long it was paused so far, and since when it is now. */
    private long pausedNs;
    private long pauseNs;
    private Exception failure;

    /**
     * Plays nothing yet.
     *
     * @param client gets the stream; with {@link PsaoConfig#twoThreads} if another thread takes
     * @param recording a whole stream; closed at the end of {@link #run}
     */
    public PsaoPlayer(PsaoClient client, InputStream recording) {
        this.client = client;
        this.recording = recording;
    }

    /** Plays to the end of the recording, or until it is closed, or until something fails. */
    @Override
    public void run() {
        try (InputStream in = recording) {
            play(in);
        } catch (IOException | RuntimeException error) {
            synchronized (lock) {
                failure = error;
            }
        }
    }

    private void play(InputStream in) throws IOException {
        byte[] piece = new byte[PIECE_BYTES];
        PsaoBuffer input = new PsaoBuffer(PIECE_BYTES);
        PsaoStats stats = new PsaoStats();
        boolean first = true;
        long offsetNs = 0;
        for (int bytes = in.read(piece); bytes >= 0; bytes = in.read(piece)) {
            input.bytes().clear();
            input.bytes().put(piece, 0, bytes);
            input.bytes().flip();
            while (input.bytes().hasRemaining()) {
                if (client.push(input, System.nanoTime()) != PsaoResult.OK) {
                    continue;
                }
                client.stats(stats);
                if (first) {
                    offsetNs = System.nanoTime() - stats.serverTimeNs();
                    first = false;
                }
                // Each frame stays until it is due; what comes behind it is pushed then.
                if (!waitUntil(offsetNs + stats.serverTimeNs())) {
                    return;
                }
            }
        }
    }

    /** Waits for a time, and while it is paused. Answers whether to go on. */
    private boolean waitUntil(long dueNs) {
        synchronized (lock) {
            while (!closed) {
                long leftNs = dueNs + pausedNs - System.nanoTime();
                if (!paused && leftNs <= 0) {
                    return true;
                }
                try {
                    lock.wait(paused ? 0 : leftNs / NS_PER_MS + 1);
                } catch (InterruptedException interrupted) {
                    Thread.currentThread().interrupt();
                    closed = true;
                }
            }
            return false;
        }
    }

    /** Stops where it is: the app is not seen. Again does nothing. */
    public void pause() {
        synchronized (lock) {
            if (!paused) {
                paused = true;
                pauseNs = System.nanoTime();
            }
        }
    }

    /** Goes on where it stopped. Again does nothing. */
    public void resume() {
        synchronized (lock) {
            if (paused) {
                paused = false;
                pausedNs += System.nanoTime() - pauseNs;
                lock.notifyAll();
            }
        }
    }

    /**
     * What ended it early.
     *
     * @return an {@link IOException} of the recording, a {@link PsaoException} of the client, an
     *     {@link IllegalStateException} if the client was closed; null if nothing did
     */
    public Exception failure() {
        synchronized (lock) {
            return failure;
        }
    }

    /** Ends {@link #run} soon. Again does nothing. */
    @Override
    public void close() {
        synchronized (lock) {
            closed = true;
            lock.notifyAll();
        }
    }
}
