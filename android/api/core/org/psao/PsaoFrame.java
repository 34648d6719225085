package org.psao;

import java.nio.ByteBuffer;
import java.nio.ByteOrder;

/**
 * A complete frame, yours from {@link PsaoClient#take} to {@link PsaoClient#release}. A client has
 * one of these objects. Its buffers lie in the client's memory: nothing is copied, and nothing is
 * freed before the last of them is unreachable, whatever is closed. Outside of take and release
 * they hold anything.
 *
 * <p>Threads: the taker's.
 */
public final class PsaoFrame {
    /** The instances: 64 bytes each. */
    public static final int INSTANCES = 0;
    /** The buckets: 32 bytes each. */
    public static final int BUCKETS = 1;
    /** The cells: 32 bytes each. */
    public static final int CELLS = 2;
    /** The most ranges that {@link #dirtyRanges} lists. */
    public static final int MAX_RANGES = 64;

    final Words words = new Words(9);
    private final Words ranges = new Words(MAX_RANGES);
    private final PsaoClient client;
    private final ByteBuffer[] views = new ByteBuffer[3];
    /** Of which buffer the ranges are, and how many. */
    private int listed;
    private int rangeCount;

    PsaoFrame(PsaoClient client) {
        this.client = client;
    }

    /** Looks at the buffers of a frame that was just taken. */
    void taken() {
        rangeCount = 0;
        for (int buffer = 0; buffer < views.length; buffer++) {
            int bytes = count(buffer) * elementBytes(buffer);
            // They stay where they are, but a new stream may have other lengths.
            if (views[buffer] == null || views[buffer].capacity() != bytes) {
                views[buffer] = client.view(words.get(6 + buffer), bytes);
            }
        }
    }

    /**
     * Its number, for {@link PsaoUplink#ack}.
     *
     * @return 32 bits without sign
     */
    public int frameId() {
        return (int) words.get(0);
    }

    /**
     * Scene time of this state.
     *
     * @return nanoseconds
     */
    public long serverTimeNs() {
        return words.get(1);
    }

    /**
     * Kernel for the lookup.
     *
     * @return 0 paper, 1 planar
     */
    public int kernel() {
        return (int) words.get(2);
    }

    /**
     * How many elements a buffer has. It changes only where a new stream says so; all is dirty
     * then.
     *
     * @param buffer {@link #INSTANCES}, {@link #BUCKETS} or {@link #CELLS}
     * @return elements
     * @throws IllegalArgumentException if it is no buffer
     */
    public int count(int buffer) {
        elementBytes(buffer);
        return (int) words.get(3 + buffer);
    }

    /**
     * How long a buffer's elements are.
     *
     * @param buffer {@link #INSTANCES}, {@link #BUCKETS} or {@link #CELLS}
     * @return bytes
     * @throws IllegalArgumentException if it is no buffer
     */
    public static int elementBytes(int buffer) {
        if (buffer < INSTANCES || buffer > CELLS) {
            throw new IllegalArgumentException("buffer " + buffer + ": 0, 1 or 2");
        }
        return buffer == INSTANCES ? 64 : 32;
    }

    /**
     * A whole buffer, laid out as shaders read it.
     *
     * @param buffer {@link #INSTANCES}, {@link #BUCKETS} or {@link #CELLS}
     * @return read-only, direct, in native order, from its beginning to its end; the same object
     *     with every frame of a stream, which {@link #range} gives too
     * @throws IllegalArgumentException if it is no buffer
     */
    public ByteBuffer buffer(int buffer) {
        elementBytes(buffer);
        views[buffer].clear();
        return views[buffer];
    }

    /**
     * Lists what of a buffer changed since the last release: what to upload. The first frame's
     * ranges cover the whole buffer, so yours needs no clearing. Ask {@link #range} and the others
     * for each before you list those of another buffer.
     *
     * @param buffer {@link #INSTANCES}, {@link #BUCKETS} or {@link #CELLS}
     * @param joinCount ranges with at most so many unchanged elements between them come as one: an
     *     upload has a price of its own; 16 suits most
     * @return how many ranges, at most {@link #MAX_RANGES}, of which the last then covers all the
     *     rest
     * @throws PsaoException {@link PsaoResult#ERROR_ORDER}: no frame is taken
     * @throws IllegalArgumentException if it is no buffer, or the other number is below 0
     * @throws IllegalStateException if the client is closed, or two threads take at once
     */
    public int dirtyRanges(int buffer, int joinCount) {
        elementBytes(buffer);
        if (joinCount < 0) {
            throw new IllegalArgumentException("joinCount " + joinCount + ": 0 or more");
        }
        rangeCount = 0;
        rangeCount = client.dirtyRanges(buffer, joinCount, ranges.address);
        listed = buffer;
        return rangeCount;
    }

    /**
     * Copies buckets with a tag in each entry, which {@code psao_planar_fast} of the shaders wants:
     * it then reads no cell in vain. Copy the dirty ranges of {@link #BUCKETS} so, and upload the
     * copies instead of {@link #range}.
     *
     * @param firstIndex the first bucket
     * @param count how many
     * @param outBuckets 32 bytes for each, from its first byte
     * @throws PsaoException {@link PsaoResult#ERROR_ORDER}: no frame is taken.
     *     {@link PsaoResult#ERROR_VALUE}: there are no such buckets.
     *     {@link PsaoResult#ERROR_CAPACITY}: the frame has more than 4194304 cells: upload the
     *     buckets as they are, and call {@code psao_planar}
     * @throws IllegalArgumentException if a number is below 0, or the buffer too short
     * @throws IllegalStateException if the client is closed, or two threads take at once
     */
    public void tagBuckets(int firstIndex, int count, PsaoBuffer outBuckets) {
        if (firstIndex < 0 || count < 0 || outBuckets.bytes().capacity() < 32L * count) {
            throw new IllegalArgumentException(
                    count + " buckets from " + firstIndex + " need 32 bytes each, and no number "
                    + "below 0");
        }
        client.tagBuckets(firstIndex, count, outBuckets);
    }

    /**
     * First element of a range.
     *
     * @param index of the range, below what {@link #dirtyRanges} said
     * @return its index in the buffer
     * @throws IndexOutOfBoundsException if there is no such range
     */
    public int rangeFirst(int index) {
        return ranges.bytes.getInt(8 * checked(index));
    }

    /**
     * Elements of a range.
     *
     * @param index of the range, below what {@link #dirtyRanges} said
     * @return a count
     * @throws IndexOutOfBoundsException if there is no such range
     */
    public int rangeCount(int index) {
        return ranges.bytes.getInt(8 * checked(index) + 4);
    }

    /**
     * Where a range begins: to where in your buffer it goes.
     *
     * @param index of the range, below what {@link #dirtyRanges} said
     * @return bytes
     * @throws IndexOutOfBoundsException if there is no such range
     */
    public int rangeOffsetBytes(int index) {
        return rangeFirst(index) * elementBytes(listed);
    }

    /**
     * A range's bytes, to upload.
     *
     * @param index of the range, below what {@link #dirtyRanges} said
     * @return the object that {@link #buffer} gives, with the range between position and limit
     * @throws IndexOutOfBoundsException if there is no such range
     */
    public ByteBuffer range(int index) {
        int from = rangeOffsetBytes(index);
        ByteBuffer view = views[listed];
        view.clear();
        view.limit(from + rangeCount(index) * elementBytes(listed));
        view.position(from);
        return view;
    }

    private int checked(int index) {
        if (index < 0 || index >= rangeCount) {
            throw new IndexOutOfBoundsException("range " + index + " of " + rangeCount);
        }
        return index;
    }

    /** A part of a client's memory, as shaders' buffers are seen. */
    static ByteBuffer part(ByteBuffer memory, long offset, int bytes) {
        ByteBuffer part = memory.duplicate();
        part.clear();
        part.position((int) offset);
        part.limit((int) offset + bytes);
        return part.slice().asReadOnlyBuffer().order(ByteOrder.nativeOrder());
    }
}
