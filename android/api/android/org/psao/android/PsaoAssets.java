package org.psao.android;

import android.content.res.AssetManager;
import java.io.EOFException;
import java.io.IOException;
import java.io.InputStream;
import org.psao.PsaoBuffer;
import org.psao.PsaoClient;
import org.psao.PsaoConfig;
import org.psao.PsaoException;
import org.psao.PsaoPlayer;

/**
 * Recordings that are packaged with the app, in {@code src/main/assets}. They are compressed
 * already: {@code androidResources.noCompress += "psao"} keeps the package from trying again.
 */
public final class PsaoAssets {
    /** So many bytes of a stream always hold its first packet. */
    private static final int FIRST_BYTES = 4116;

    private PsaoAssets() {}

    /**
     * Makes a config with just what a recording needs. Threads: any, but it reads a file.
     *
     * @param assets the app's
     * @param name the asset's path
     * @return the config
     * @throws IOException if there is no such asset, or it ends too soon
     * @throws PsaoException if it is no recording
     */
    public static PsaoConfig config(AssetManager assets, String name) throws IOException {
        byte[] first = new byte[FIRST_BYTES];
        int bytes = 0;
        try (InputStream in = assets.open(name)) {
            int read = 0;
            while (read >= 0 && bytes < first.length) {
                bytes += read;
                read = in.read(first, bytes, first.length - bytes);
            }
        }
        PsaoBuffer buffer = new PsaoBuffer(FIRST_BYTES);
        buffer.bytes().put(first, 0, bytes).flip();
        PsaoConfig config = PsaoConfig.fromStream(buffer);
        if (config == null) {
            throw new EOFException(name + " ends before its first packet does: package it anew");
        }
        return config;
    }

    /**
     * Opens a recording, to be played by a thread of yours.
     *
     * @param client gets the stream
     * @param assets the app's
     * @param name the asset's path
     * @return a player that closes the asset when it ends
     * @throws IOException if there is no such asset
     */
    public static PsaoPlayer player(PsaoClient client, AssetManager assets, String name)
            throws IOException {
        return new PsaoPlayer(client, assets.open(name));
    }
}
