package org.psao;

import java.nio.ByteBuffer;
import java.nio.ByteOrder;

/**
 * A direct buffer that native code reads and writes. Its address is looked up once, here, and not
 * with every call: make it once, and use it for as long as you like.
 *
 * <p>Threads: as those of {@link ByteBuffer}: one at a time.
 */
public final class PsaoBuffer {
    private final ByteBuffer bytes;
    final long address;

    /**
     * Makes a buffer.
     *
     * @param capacityBytes how long it is, 0 or more
     * @throws IllegalArgumentException if it is negative
     */
    public PsaoBuffer(int capacityBytes) {
        this(ByteBuffer.allocateDirect(capacityBytes));
    }

    /**
     * Takes a buffer that there is. Its memory is shared; position and limit are that of
     * {@link #bytes} from now on.
     *
     * @param direct a direct buffer that may be written to
     * @throws IllegalArgumentException if it is not direct, or read-only
     */
    public PsaoBuffer(ByteBuffer direct) {
        if (!direct.isDirect() || direct.isReadOnly()) {
            throw new IllegalArgumentException(
                    "native code needs a direct buffer that may be written to: "
                    + "ByteBuffer.allocateDirect makes one");
        }
        bytes = direct.duplicate().order(ByteOrder.nativeOrder());
        // Of an empty buffer it may be 0, and nothing of it is read.
        address = Native.address(bytes);
    }

    /**
     * The bytes, in native order. Methods that read begin at its position, end at its limit, and
     * move the position behind what they used; so do methods that write.
     *
     * @return always the same object
     */
    public ByteBuffer bytes() {
        return bytes;
    }

    /** Refuses memory that native code would read from and write to at once. */
    static void checkApart(PsaoBuffer input, long inputBytes, long output, long outputBytes) {
        if (input.address < output + outputBytes && output < input.address + inputBytes) {
            throw new IllegalArgumentException("input and output share memory: use two buffers");
        }
    }
}
