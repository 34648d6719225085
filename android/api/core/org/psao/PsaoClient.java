package org.psao;

import java.nio.ByteBuffer;
import java.util.concurrent.atomic.AtomicInteger;

/**
 * Follows one stream: bytes in, complete frames out. It does no input or output, has no thread and
 * no clock, and takes no memory but one block when it is made.
 *
 * <p>Threads. Two sides use it: the pusher ({@link #push}, {@link #restart}, {@link #header},
 * {@link #topologyHash}, {@link #stats}) and the taker ({@link #take}, {@link #lookup},
 * {@link #release}, and the methods of {@link PsaoFrame}). Each side must be one thread at a time.
 * With {@link PsaoConfig#twoThreads} both sides may run at once, and neither ever waits for the
 * other; without, they must not. {@link #status} and {@link #close} are anyone's, at any time. A
 * thread that comes while it must not gets an {@link IllegalStateException}, and nothing happens.
 *
 * <p>Memory. The block is a direct buffer, which the garbage collector frees when neither the
 * client nor a buffer of its frame can be reached. {@link #close} is safe at any time, also while
 * other threads are in a method: they finish, and their next call throws.
 */
public final class PsaoClient implements AutoCloseable {
    private static final int PUSHER = 1;
    private static final int TAKER = 2;
    private static final int CLOSED = 4;
    /** Closed, and nothing runs any more: the log's native part is freed. */
    private static final int FREED = 8;

    private final ByteBuffer memory;
    private final long memoryAddress;
    /** Of the native client, in the memory. */
    private final long client;
    private final Words pusherWords = new Words(1);
    private final PsaoFrame frame = new PsaoFrame(this);
    /** Held here, for native code only looks at it. */
    private final PsaoLog log;
    private final long nativeLog;
    /** Which sides are in a native function, and whether it is closed. */
    private final AtomicInteger use = new AtomicInteger();
    private final int pusher;
    private final int taker;

    /**
     * Makes a client that says nothing.
     *
     * @param config what it may hold
     * @throws PsaoException {@link PsaoResult#ERROR_VALUE}: as {@link PsaoConfig#memoryBytes}
     * @throws OutOfMemoryError if there is less memory than that
     */
    public PsaoClient(PsaoConfig config) {
        this(config, null);
    }

    /**
     * Makes a client.
     *
     * <p>Threads: any. Takes all the memory that the client ever takes; may log.
     *
     * @param config what it may hold
     * @param log takes messages; may be null
     * @throws PsaoException {@link PsaoResult#ERROR_VALUE}: as {@link PsaoConfig#memoryBytes}, or
     *     that is more than 2 GiB
     * @throws OutOfMemoryError if there is less memory than that
     */
    public PsaoClient(PsaoConfig config, PsaoLog log) {
        long bytes = config.memoryBytes();
        if (bytes > Integer.MAX_VALUE) {
            throw new PsaoException(PsaoResult.ERROR_VALUE, bytes + " bytes; Java has 2^31 - 1");
        }
        memory = ByteBuffer.allocateDirect((int) bytes);
        memoryAddress = Native.address(memory);
        pusher = config.twoThreads ? PUSHER : PUSHER | TAKER;
        taker = config.twoThreads ? TAKER : PUSHER | TAKER;
        this.log = log;
        nativeLog = log == null ? 0 : Native.openLog(log);
        int result = Native.init(
                config.words(), memoryAddress, bytes, nativeLog, pusherWords.address);
        if (result < 0) {
            close();
            throw new PsaoException(result, "");
        }
        client = pusherWords.get(0);
    }

    /**
     * Feeds stream bytes, in any portions: those between the buffer's position and its limit. The
     * position is then behind what was used.
     *
     * <p>Stops behind every completed frame with {@link PsaoResult#OK}: take it, then push the
     * rest. Everything else that is no failure has used up all of the input:
     * {@link PsaoResult#NEED_MORE}, and {@link PsaoResult#RESYNC} after which you should send
     * {@link PsaoUplink#resync}.
     *
     * <p>Push an empty buffer when your transport shows that the link lives though nothing came (a
     * still scene sends nothing), and now and then with two threads: it hands over what the taker
     * was too busy for.
     *
     * <p>Threads: pusher. Time: what the input asks for, bounded by its size and the config. No
     * garbage, lock or log. Safe on untrusted input.
     *
     * @param input the bytes; must not be written to meanwhile
     * @param nowNs a clock of yours that does not run backwards, in nanoseconds; only differences
     *     count. 0 if you have none
     * @return {@link PsaoResult#OK}, {@link PsaoResult#NEED_MORE} or {@link PsaoResult#RESYNC}
     * @throws PsaoException {@link PsaoResult#ERROR_ORDER}: with one thread, while a frame is
     *     taken. Any other ends the stream: the last frame stays in place, the message has a
     *     sentence for a log, and {@link #restart} makes ready for a new stream
     * @throws IllegalStateException if it is closed, or another thread is in the pusher's part
     */
    public int push(PsaoBuffer input, long nowNs) {
        enter(pusher);
        try {
            ByteBuffer bytes = input.bytes();
            int from = bytes.position();
            int length = Math.max(0, bytes.limit() - from);
            long answer = Native.push(client, input.address + from, length, nowNs, this, input);
            if (answer < 0) {
                throw streamFailure((int) answer);
            }
            bytes.position(from + (int) (answer >> 8));
            return (int) answer & 0xff;
        } finally {
            leave(pusher);
        }
    }

    private PsaoException streamFailure(int result) {
        boolean ofStream = result <= PsaoResult.ERROR_FAILED && result > PsaoResult.ERROR_INTERNAL;
        return new PsaoException(result, ofStream ? Native.errorText(client, this) : "");
    }

    /**
     * Makes ready for a new stream, from its first byte, after a lost connection or a failure. The
     * last frame stays in place until the new stream's first snapshot: AO freezes, and does not
     * flash.
     *
     * <p>Threads: pusher. No lock; may log.
     *
     * @throws IllegalStateException if it is closed, or another thread is in the pusher's part
     */
    public void restart() {
        enter(pusher);
        try {
            PsaoException.check(Native.restart(client, this));
        } finally {
            leave(pusher);
        }
    }

    /**
     * Reads what the stream says of itself.
     *
     * <p>Threads: pusher. No garbage, lock or log.
     *
     * @param out filled in
     * @throws PsaoException {@link PsaoResult#ERROR_ORDER}: before its header has come
     * @throws IllegalStateException if it is closed, or another thread is in the pusher's part
     */
    public void header(PsaoHeader out) {
        enter(pusher);
        try {
            PsaoException.check(Native.header(client, out.words.address, this, out));
        } finally {
            leave(pusher);
        }
    }

    /**
     * Reads the totals.
     *
     * <p>Threads: pusher. No garbage, lock or log.
     *
     * @param out filled in
     * @throws IllegalStateException if it is closed, or another thread is in the pusher's part
     */
    public void stats(PsaoStats out) {
        enter(pusher);
        try {
            PsaoException.check(Native.stats(client, out.words.address, this, out));
        } finally {
            leave(pusher);
        }
    }

    /**
     * Reads the hash of the patches that the client has got, for {@link PsaoUplink#hello} of a new
     * connection: the server then need not send them again. Read it before {@link #restart}, and
     * keep the client. A recording of patches alone ({@code psao record --topology}), shipped with
     * the app and pushed first, gives the same.
     *
     * <p>Threads: pusher. No garbage, lock or log.
     *
     * @return 64 bits; 0 if some are missing
     * @throws IllegalStateException if it is closed, or another thread is in the pusher's part
     */
    public long topologyHash() {
        enter(pusher);
        try {
            PsaoException.check(Native.topologyHash(client, pusherWords.address, this));
            return pusherWords.get(0);
        } finally {
            leave(pusher);
        }
    }

    /**
     * Says how the client is: whether its frame is the server's, and if not, since when.
     *
     * <p>Threads: any, at any time. No garbage, lock or log.
     *
     * @param nowNs the clock of {@link #push}, in nanoseconds
     * @param out filled in
     * @throws IllegalStateException if it is closed
     */
    public void status(long nowNs, PsaoStatus out) {
        checkOpen(use.get());
        PsaoException.check(Native.status(client, nowNs, out.words.address, this, out));
    }

    /**
     * Takes the newest complete frame. It is yours, and nothing changes it, until {@link #release}.
     * With two threads, what comes meanwhile waits in the pusher's copy and comes with a later
     * frame, all of it and in order.
     *
     * <p>Threads: taker. Time: constant. No garbage, lock or log, but with a stream's first frame.
     *
     * @return always the same object; null if none came since the last one that you took, or the
     *     pusher is just handing one over: go on with what you have, there is nothing to release
     * @throws PsaoException {@link PsaoResult#ERROR_ORDER}: you still have one
     * @throws IllegalStateException if it is closed, or another thread is in the taker's part
     */
    public PsaoFrame take() {
        enter(taker);
        try {
            int result = PsaoException.check(Native.take(client, frame.words.address, this));
            if (result != PsaoResult.OK) {
                return null;
            }
            frame.taken();
            return frame;
        } finally {
            leave(taker);
        }
    }

    int dirtyRanges(int buffer, int joinCount, long ranges) {
        enter(taker);
        try {
            int most = PsaoFrame.MAX_RANGES;
            return PsaoException.check(
                    Native.dirtyRanges(client, buffer, joinCount, ranges, most, this));
        } finally {
            leave(taker);
        }
    }

    void tagBuckets(int firstIndex, int count, PsaoBuffer outBuckets) {
        enter(taker);
        try {
            PsaoException.check(Native.tagBuckets(
                    client, firstIndex, count, outBuckets.address, this, outBuckets));
        } finally {
            leave(taker);
        }
    }

    /** A part of the memory. */
    ByteBuffer view(long address, int bytes) {
        return PsaoFrame.part(memory, address - memoryAddress, bytes);
    }

    /**
     * Looks ambient occlusion up at points of one instance, on the CPU: what the shader does for
     * each fragment. All buffers are used from their first byte, whatever their position.
     *
     * <p>Threads: taker. Time: grows with count. No garbage, lock or log. Safe on untrusted input.
     *
     * @param instanceIndex which
     * @param positions count of them, of three floats each, in the instance's local space (its rest
     *     space if it is skinned)
     * @param normals count of them, of three floats each, of any length
     * @param count how many
     * @param outOpenness count floats, 0 fully occluded to 1 open, never NaN. Unknown instances,
     *     positions outside and numbers that are none answer 1
     * @throws PsaoException {@link PsaoResult#ERROR_ORDER}: no frame is taken.
     *     {@link PsaoResult#ERROR_VALUE}: a buffer's memory is not aligned to 4 bytes
     * @throws IllegalArgumentException if count is below 0, a buffer is too short, or outOpenness
     *     shares memory with another one
     * @throws IllegalStateException if it is closed, or another thread is in the taker's part
     */
    public void lookup(
            int instanceIndex, PsaoBuffer positions, PsaoBuffer normals, int count,
            PsaoBuffer outOpenness) {
        long bytes = 12L * count;
        if (count < 0 || positions.bytes().capacity() < bytes
                || normals.bytes().capacity() < bytes
                || outOpenness.bytes().capacity() < bytes / 3) {
            throw new IllegalArgumentException(count + " points need 12 bytes each in positions "
                    + "and normals, and 4 in outOpenness");
        }
        PsaoBuffer.checkApart(positions, bytes, outOpenness.address, bytes / 3);
        PsaoBuffer.checkApart(normals, bytes, outOpenness.address, bytes / 3);
        enter(taker);
        try {
            PsaoException.check(Native.lookup(
                    client, instanceIndex, positions.address, normals.address, count,
                    outOpenness.address, this, positions, normals, outOpenness));
        } finally {
            leave(taker);
        }
    }

    /**
     * Gives the frame back. Everything that was dirty in it counts as uploaded.
     *
     * <p>Threads: taker. Time: grows with what changed. No garbage, lock or log.
     *
     * @throws PsaoException {@link PsaoResult#ERROR_ORDER}: no frame is taken
     * @throws IllegalStateException if it is closed, or another thread is in the taker's part
     */
    public void release() {
        enter(taker);
        try {
            PsaoException.check(Native.release(client, this));
        } finally {
            leave(taker);
        }
    }

    /**
     * Makes everything dirty: call it when your buffers were lost with their device, or made anew.
     * The next {@link #take} then gives the newest frame, even if you had it before, and its ranges
     * cover the whole buffers.
     *
     * <p>Threads: taker. Time: constant; the next take's grows with the capacity. No garbage, lock
     * or log.
     *
     * @throws PsaoException {@link PsaoResult#ERROR_ORDER}: a frame is taken; release it first
     * @throws IllegalStateException if it is closed, or another thread is in the taker's part
     */
    public void markAllDirty() {
        enter(taker);
        try {
            PsaoException.check(Native.markAllDirty(client, this));
        } finally {
            leave(taker);
        }
    }

    /**
     * The native client, for native code of the same app that includes {@code psao.h} and links
     * {@code psao_jni}: an engine takes frames while Java pushes. The header's rules hold there,
     * and nothing checks them: each side is one thread at a time, in Java and native code together.
     *
     * @return a {@code psao_client *}, good for as long as this object can be reached and is not
     *     closed
     * @throws IllegalStateException if it is closed
     */
    public long nativeClient() {
        checkOpen(use.get());
        return client;
    }

    /**
     * Ends the client: every later call throws, and calls that run now finish. Doing it again does
     * nothing. The memory goes when nothing can reach it any more.
     *
     * <p>Threads: any, at any time.
     */
    @Override
    public void close() {
        leave(0, CLOSED);
    }

    /** Begins a native function. */
    private void enter(int side) {
        int now;
        do {
            now = use.get();
            checkOpen(now);
            if ((now & side) != 0) {
                throw new IllegalStateException(side == (PUSHER | TAKER)
                        ? "two threads use a client at once that has not PsaoConfig.twoThreads"
                        : "two threads " + (side == PUSHER ? "push" : "take") + " at once");
            }
        } while (!use.compareAndSet(now, now | side));
    }

    private static void checkOpen(int use) {
        if ((use & CLOSED) != 0) {
            throw new IllegalStateException("the client is closed: make a new one");
        }
    }

    private void leave(int side) {
        leave(side, 0);
    }

    /** Ends a native function; whoever is the last in a closed client clears up. */
    private void leave(int side, int also) {
        int now;
        int then;
        do {
            now = use.get();
            then = now & ~side | also;
            if ((then & (CLOSED | PUSHER | TAKER)) == CLOSED) {
                then |= FREED;
            }
        } while (!use.compareAndSet(now, then));
        if ((then & ~now & FREED) != 0 && nativeLog != 0) {
            Native.closeLog(nativeLog);
        }
    }
}
